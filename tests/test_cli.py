"""What the command line says without a dataset."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from wheretolook import cli
from wheretolook.cli import main
from wheretolook.scorers.registry import describe_methods, scorers


def test_methods_are_listed_without_a_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "--list-methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [*scorers()]
    assert not [*tmp_path.iterdir()]
    texts = dict(line.split(maxsplit=1) for line in lines)
    assert texts == describe_methods()
    assert texts["bins"].startswith("Share of the image's bins")
    assert texts["fisher-logdet-gp"].endswith(": logdet, gp.")
    assert "probability" in texts["mlp-2d+z"]
    assert len(set(texts.values())) == len(texts)
    assert all(20 < len(text) < 140 for text in texts.values())


def test_only_evaluate_lists_methods(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "--list-methods"]) == 2
    assert "list-methods" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stage", "says"),
    [
        (
            "viewpoint-map",
            ["--scenes.mapped_space.clearance_m", "--map.photographs.assume_metric", "photographs has no"],
        ),
        ("plan", ["--plan.start", "--plan.film", "wheretolook plan --config", "--tracking.folder", "model tsdf"]),
    ],
)
def test_help_names_what_a_stage_reads(stage: str, says: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([stage, "--help-all"]) == 0
    said = capsys.readouterr().out
    assert [text for text in says if text not in said] == [] and "--evaluate" not in said


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--start", "[.nan, 1, 1]", "plan.start must be finite"),
        ("--goal", "[1, 1, .inf]", "plan.goal must be finite"),
        ("--plan.planner.time_s", ".inf", "time_s must be positive and finite"),
    ],
)
def test_a_plan_with_numbers_that_are_not_finite_is_refused(
    option: str, value: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", option, value]) == 2
    assert message in capsys.readouterr().err


def test_ctrl_c_stays_one_where_it_is_lost_or_made_another_error_of(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Python does while it removes an object, and safetensors while it reads a tensor."""

    def reads(*_: object) -> int:
        gc.collect()  # one in the next moment would swallow the interrupt, as hypothesis listens to collections
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            raise ValueError("could not determine the shape") from error
        return 0

    class Removed:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    def goes_on(*_: object) -> int:
        Removed()
        time.sleep(60)
        return 0

    monkeypatch.setattr(cli, "_run", goes_on)
    start = time.monotonic()
    assert main(["scenes"]) == 130
    began = threading.Thread.start

    def starts_slowly(thread: threading.Thread) -> None:
        began(thread)
        time.sleep(0.1)

    monkeypatch.setattr(threading.Thread, "start", starts_slowly)  # as on a busy machine
    assert main(["scenes"]) == 130
    monkeypatch.setattr(threading.Thread, "start", began)
    assert time.monotonic() - start < 30
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setattr(cli, "_run", reads)
    assert main(["scenes"]) == 130
    assert "wheretolook: interrupted" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["check", "--scene", "cellar"], "There are hall."),
        (["check", "--scene", "hall", "--name", "other"], "this folder is no dataset"),
        (["view", "--scene", "cellar", "--port", "0"], "There are hall."),
        (["release", "--name", "mine", "--release_name", "mine"], "the name of the dataset that it is a copy of"),
    ],
)
def test_what_can_be_refused_is_before_long_imports(arguments: list[str], says: str, tmp_path: Path) -> None:
    scenes = [{"name": "hall", "split": "test"}]
    camera = {"width": 64, "height": 48, "focal_px": 32.0}
    (tmp_path / "mine" / "hall").mkdir(parents=True)
    (tmp_path / "mine" / "dataset.json").write_text(json.dumps({"camera": camera, "scenes": scenes}))
    before = sorted(tmp_path.rglob("*"))
    code = "import sys; from wheretolook.cli import main; end = main(sys.argv[1:]); "
    code += "print(*({'pandas', 'torch', 'mlflow', 'lightning'} & {*sys.modules}), file=sys.stderr); "
    code += "sys.exit(end)"
    run = [sys.executable, "-c", code, *arguments, "--data", str(tmp_path)]
    ended = subprocess.run(run, env={**os.environ, "PYTHONPATH": "src"}, capture_output=True, text=True, check=False)
    lines = ended.stderr.splitlines()
    assert ended.returncode == 2 and says in lines[0] and [line for line in lines[1:] if line] == []
    assert sorted(tmp_path.rglob("*")) == before
