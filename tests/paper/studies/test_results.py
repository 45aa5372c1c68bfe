"""The commands that make the results: each is real, and is repeated when what it reads has changed."""

import argparse
import importlib
import json
import runpy
import sys
from pathlib import Path

import pandas as pd
import pytest
from jsonargparse import auto_parser

from wheretolook.cli import parse_command
from wheretolook_paper.paths.path_report import pooled_paths
from wheretolook_paper.studies import compare_hloc
from wheretolook_paper.studies.results import MADE, RESULTS, SET, outdated, steps

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("name", list(steps()))
def test_commands_have_real_options(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    for program, *options in steps(Path("scans"), Path("photographs"), "cpu")[name].commands:
        if program == "wheretolook":
            parse_command(options[0], options[1:])
        elif program.endswith(".py"):
            check_script(program, options, monkeypatch)
        else:
            module = importlib.import_module(program)
            main = {"compare": compare_hloc.main, "draw": compare_hloc.draw} if module is compare_hloc else module.main
            auto_parser(main, as_positional=False).parse_args(options)


def check_script(program, options, monkeypatch):
    """Parse the options of a script of benchmarks, or find the notebooks' script."""
    if program == "notebooks/execute.py":
        assert Path(program).is_file() and not options
        return
    parse = argparse.ArgumentParser.parse_args

    def stop(parser):
        parse(parser, options)
        raise InterruptedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    monkeypatch.setattr(sys, "path", [str(Path(program).parent), *sys.path])
    with pytest.raises(InterruptedError):
        runpy.run_path(program, run_name="__main__")
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)


def test_a_step_is_repeated_when_weights_or_a_table_change():
    SET.parent.mkdir(parents=True)
    RESULTS.mkdir()
    SET.write_bytes(b"weights")
    table = RESULTS / "paths.csv"
    table.write_text("scene\n")
    MADE.write_text(json.dumps({name: step.record() for name, step in steps().items()}))
    assert [*outdated()] == ["pages"]  # is always up to date once it has run
    assert [*outdated(["film"])] == ["film"]
    table.write_text("scene\nall\n")
    assert [*outdated()] == ["notebooks", "pictures", "pages"]
    SET.write_bytes(b"others")
    assert {"interiors", "film", "paths-aws_house", "release"} < {*outdated()}


def test_scenes_are_combined_to_all():
    table = pd.read_csv(ROOT / RESULTS / "paths.csv")
    pooled = pooled_paths(table[table["scene"] != "all"])
    stored = table[table["scene"] == "all"].reset_index(drop=True)
    pd.testing.assert_frame_equal(pooled[pooled.columns], stored[pooled.columns], rtol=1e-4, check_dtype=False)
    half = pd.DataFrame({"task": "given", "method": "forward", "pairs": 10, "failures": [0, 5], "views": [300, 100],
                         "localized": [0.4, 0.8], "localized_low": [0.3, 0.8], "localized_high": [0.4, 0.9],
                         "times_forward_length": 1.0, "length_m": [3.0, 6.0], "turn_deg_per_m": [10.0, 20.0],
                         "promised": 0.5})  # fmt: skip
    (row,) = pooled_paths(half).to_dict("records")
    assert row["localized"] == pytest.approx(0.5) and row["length_m"] == pytest.approx(4)
    assert row["localized_low"] == pytest.approx(0.5 - 0.75 * 0.1)
    assert row["localized_high"] == pytest.approx(0.5 + 0.25 * 0.1)
    assert row["turn_deg_per_m"] == pytest.approx(15) and row["times_forward"] == 1
