"""MLflow stores that cannot be used: one error within seconds, before work starts, and results that outlive them."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.disks import fill, read_only, small_disk

from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import artifact, experiment_id, finished_runs, log, start_run
from wheretolook.tracking.store import check_store, client, kept_if_not_logged
from wheretolook.utils.errors import TrackingError, TrackingWarning

SOON_S = 10.0
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def own_uri(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stores are made here as they are made for users, not as copies of one that is there."""
    monkeypatch.setattr(TrackingConfig, "uri", property(lambda tracking: f"sqlite:///{tracking.root / 'mlflow.db'}"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, migrated_stores: None) -> bytes:
    tracking = TrackingConfig(str(tmp_path_factory.mktemp("made")))
    client(tracking)
    return (tracking.root / "mlflow.db").read_bytes()


@pytest.fixture
def store(tmp_path: Path, made: bytes) -> TrackingConfig:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    tracking.root.mkdir()
    (tracking.root / "mlflow.db").write_bytes(made)
    return tracking


def refused(tracking: TrackingConfig) -> TrackingError:
    """The error of a store, which comes soon and is one line."""
    start = time.monotonic()
    with pytest.raises(TrackingError) as raised:
        check_store(tracking)
    assert time.monotonic() - start < SOON_S
    assert raised.value.path is not None and raised.value.fix
    assert "\n" not in str(raised.value)
    return raised.value


@pytest.mark.parametrize("name", ["a%41b", "what?", "50%aF"])
def test_a_path_that_mlflow_misreads_is_refused(name: str, tmp_path: Path) -> None:
    refused(TrackingConfig(str(tmp_path / name)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["50% off", "a b#c;d&e", "ä'\"[x]"])
def test_any_other_path_serves(name: str, tmp_path: Path, made: bytes) -> None:
    tracking = TrackingConfig(str(tmp_path / name))
    tracking.root.mkdir()
    (tracking.root / "mlflow.db").write_bytes(made)
    file = tmp_path / "a.txt"
    file.write_text("a")
    check_store(tracking)
    with start_run(tracking, "a", "train") as (mlflow, run):
        mlflow.log_artifact(run, str(file))
    assert artifact(tracking, run, "a.txt").read_text() == "a"
    assert {path.name for path in tracking.root.iterdir()} == {"mlflow.db", "artifacts"}
    assert {path.name for path in tmp_path.iterdir()} == {name, "a.txt"}


def test_another_programs_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").write_text("no database, but a text that is longer than any header of one " * 5)
    refused(TrackingConfig(str(tmp_path)))


def test_a_store_of_another_version_of_mlflow_is_refused(store: TrackingConfig) -> None:
    with sqlite3.connect(store.root / "mlflow.db") as connection:
        connection.execute("UPDATE alembic_version SET version_num = '451aebb31d03'")
    connection.close()
    refused(store)


def test_a_full_disk_is_found_before_work_starts(tmp_path: Path, made: bytes) -> None:
    with small_disk(tmp_path / "disk", 8 * 2**20) as disk:
        new = TrackingConfig(str(disk / "new"))
        old = TrackingConfig(str(disk / "old"))
        filler = fill(disk, leave=300_000)
        refused(new)
        assert not [*(disk / "new").rglob("*")]
        filler.unlink()
        old.root.mkdir()
        (old.root / "mlflow.db").write_bytes(made)
        check_store(old)  # opened, and the disk is full only then
        filler = fill(disk, leave=300_000)
        refused(old)
        filler.unlink()
        check_store(old)


def test_a_read_only_disk_is_found_before_work_starts_but_can_be_read(tmp_path: Path, made: bytes) -> None:
    with small_disk(tmp_path / "disk", 8 * 2**20) as disk:
        new = TrackingConfig(str(disk / "new"))
        old = TrackingConfig(str(disk / "old"))
        old.root.mkdir()
        (old.root / "mlflow.db").write_bytes(made)
        with read_only(disk):
            refused(new)
            refused(old)
            assert not list(finished_runs(old, "train"))
            assert [experiment.name for experiment in client(old).search_experiments()] == ["Default"]


def test_results_outlive_a_store_that_fails_while_they_are_logged(tmp_path: Path, made: bytes) -> None:
    note = tmp_path / "not_logged.json"
    result = tmp_path / "result.bin"
    result.write_bytes(bytes(2**20))
    with small_disk(tmp_path / "disk", 6 * 2**20) as disk:
        tracking = TrackingConfig(str(disk / "mlruns"))
        tracking.root.mkdir()
        (tracking.root / "mlflow.db").write_bytes(made)

        def log_it() -> None:
            with kept_if_not_logged("the result", note), start_run(tracking, "a", "train") as (mlflow, run):
                log(mlflow, run, {"a": 1}, {"b": 2.0})
                mlflow.log_artifact(run, str(result))

        check_store(tracking)
        for room in (2**19, 0):
            filler = fill(disk, leave=room)
            start = time.monotonic()
            with pytest.warns(TrackingWarning):
                log_it()
            assert time.monotonic() - start < SOON_S and note.is_file()
            assert not [path for path in disk.rglob("*") if path.name.startswith("result")]
            filler.unlink()
        log_it()
        assert not note.exists()
        (run,) = finished_runs(tracking, "train")
        assert artifact(tracking, run.info.run_id, "result.bin").stat().st_size == 2**20


MAKE = """
import sys
from wheretolook.tracking.runs import start_run
from wheretolook.tracking.config import TrackingConfig
print("ready", flush=True)
sys.stdin.readline()
with start_run(TrackingConfig(sys.argv[1]), "a", "train", {"dataset": "d"}):
    pass
"""


def _starting(folder: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", MAKE, str(folder)], env=environment, text=True, **pipes)


@pytest.fixture
def begun() -> Iterator[list[subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_two_first_runs_at_once_make_one_store(tmp_path: Path, begun: list[subprocess.Popen[str]]) -> None:
    begun += [_starting(tmp_path / "mlruns") for _ in range(3)]
    for process in begun:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for process in begun:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    for process in begun:
        assert process.wait(120) == 0, process.stderr and process.stderr.read()
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    assert len(list(finished_runs(tracking, "train"))) == 3
    assert experiment_id(client(tracking), tracking, "train", "d")
    assert {path.name for path in tracking.root.iterdir()} <= {"mlflow.db", "artifacts"}
