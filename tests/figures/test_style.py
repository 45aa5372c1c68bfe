"""Figure files: formats, notes in metadata, reproducible bytes."""

import pytest

from wheretolook.figures import KINDS
from wheretolook.figures.floor_plan import new_figure, save_figure


@pytest.mark.parametrize("kind", KINDS)
def test_files_keep_a_note_and_are_reproducible(kind, tmp_path):
    contents = []
    for name, note in (("one", "runs: 1a2b, 3c4d"), ("two", "runs: 1a2b, 3c4d"), ("three", "")):
        figure = new_figure(3, 2)
        figure.subplots().plot([0, 1], [1, 0], label="a line")
        save_figure(figure, tmp_path / name / f"figure.{kind}", note)
        contents.append((tmp_path / name / f"figure.{kind}").read_bytes())
    assert contents[0] == contents[1]
    assert b"runs: 1a2b, 3c4d" in contents[0] and b"runs:" not in contents[2]
