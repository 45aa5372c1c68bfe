"""Figure files: formats, notes in metadata, reproducible bytes; names of scenes and styles of methods."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from wheretolook.figures import KINDS
from wheretolook.figures.style import new_figure, note_of, save_figure, scene_label
from wheretolook.scorers.styles import method_style
from wheretolook.utils.errors import ConfigError


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


@pytest.mark.parametrize("work", [lambda path: save_figure(drawn(), path), note_of])
def test_other_formats_are_rejected(work, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError):
        work(tmp_path / "figure.bmp")


def test_display_names_of_scenes() -> None:
    names = {"apartment-210": "apartment 210", "aws_house": "furnished house", "my_house": "my house"}
    names |= {"nexuiz_aggressor_b": "game level aggressor b", "nexuiz": "game level"}
    assert {name: scene_label(name) for name in names} == names


def test_methods_have_distinct_styles() -> None:
    styles = [method_style(name) for name in ("oracle", "random", "forward", "visible", "bins", "set", "mlp-2d")]
    for attribute in ("label", "color", "marker"):
        assert len({getattr(style, attribute) for style in styles}) == len(styles)
