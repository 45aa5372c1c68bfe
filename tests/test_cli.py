"""What the command line says without a dataset."""

from __future__ import annotations

from pathlib import Path

import pytest

from wheretolook.cli import main
from wheretolook.scoring.bins import BinsScorer
from wheretolook.scoring.registry import SCORERS, describe_methods


def test_methods_are_listed_without_a_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "--list-methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [*SCORERS]
    assert not [*tmp_path.iterdir()]
    texts = dict(line.split(maxsplit=1) for line in lines)
    assert texts == describe_methods()
    assert texts["bins"] == str(BinsScorer.__doc__).splitlines()[0]
    assert texts["fisher-logdet-gp"].endswith(": logdet, gp.")
    assert "probability" in texts["mlp"]
    assert len(set(texts.values())) == len(texts)
    assert all(20 < len(text) < 140 for text in texts.values())


def test_only_evaluate_lists_methods(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "--list-methods"]) == 2
    assert "list-methods" in capsys.readouterr().err
