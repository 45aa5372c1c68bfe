"""Files of figures: their kinds, their metadata, and that the same figure gives the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.config import KINDS
from wheretolook.figures.style import ONE_COLUMN_IN, PRINT, new_figure, note_of, save_figure, scene_label
from wheretolook.utils.errors import ConfigError


def drawn() -> Figure:
    with context(PRINT):
        figure = new_figure(ONE_COLUMN_IN, 2)
        figure.subplots().plot([0, 1], [1, 0], label="a line")
        return figure


@pytest.mark.parametrize("kind", KINDS)
def test_figures_keep_a_note_and_come_out_the_same(kind: str, tmp_path: Path) -> None:
    note = "runs: 1a2b (evaluate), 3c4d; R & D <not a tag> f(x)"
    paths = [tmp_path / name / f"figure.{kind}" for name in ("one", "two")]
    for path in paths:
        save_figure(drawn(), path, note)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert note_of(paths[0]) == note
    save_figure(drawn(), paths[1])
    assert note_of(paths[1]) == ""
    assert [path.name for path in tmp_path.rglob("*.partial")] == []


def test_vectors_keep_their_letters(tmp_path: Path) -> None:
    figure = drawn()
    figure.axes[0].set_xlabel("metres")
    save_figure(figure, tmp_path / "figure.svg")
    assert ">metres</text>" in (tmp_path / "figure.svg").read_text()


def test_other_kinds_of_files_are_refused(tmp_path: Path) -> None:
    for work in (lambda path: save_figure(drawn(), path), note_of):
        with pytest.raises(ConfigError, match=r"figure\.bmp"):
            work(tmp_path / "figure.bmp")
    assert not list(tmp_path.iterdir())


def test_scenes_have_names_for_people() -> None:
    names = {"apartment-210": "apartment 210", "aws_house": "furnished house", "my_house": "my house"}
    names |= {"nexuiz_aggressor_b": "game level aggressor b", "nexuiz": "game level"}
    assert {name: scene_label(name) for name in names} == names
