"""Figure files: formats, notes in metadata, reproducible bytes; names of scenes and styles of methods."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from wheretolook.figures import KINDS
from wheretolook.figures.style import new_figure, note_of, save_figure


def drawn() -> Figure:
    figure = new_figure(3, 2)
    figure.subplots().plot([0, 1], [1, 0], label="a line")
    return figure


@pytest.mark.parametrize("kind", KINDS)
def test_files_keep_a_note_and_are_reproducible(kind: str, tmp_path: Path) -> None:
    note = "runs: 1a2b (evaluate), 3c4d; R & D <not a tag> f(x)"
    first, second = (tmp_path / name / f"figure.{kind}" for name in ("one", "two"))
    save_figure(drawn(), first, note)
    save_figure(drawn(), second, note)
    assert first.read_bytes() == second.read_bytes()
    assert note_of(first) == note
    save_figure(drawn(), second)
    assert note_of(second) == ""
