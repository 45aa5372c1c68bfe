"""MLflow stores that cannot be used: one error within seconds, before work starts."""

import os
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from disks import fill, read_only, small_disk
from wheretolook.tracking import TrackingConfig, artifact, check_store, client, experiment_id, finished_runs, start_run
from wheretolook.utils.errors import TrackingError

SOON_S = 30.0
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def own_uri(monkeypatch):
    """Stores are made here as they are made for users, not as copies of one that is there."""
    monkeypatch.setattr(TrackingConfig, "uri", property(lambda tracking: f"sqlite:///{tracking.root / 'mlflow.db'}"))


@pytest.fixture(scope="module")
def made(tmp_path_factory, migrated_stores):
    tracking = TrackingConfig(str(tmp_path_factory.mktemp("made")))
    client(tracking)
    return (tracking.root / "mlflow.db").read_bytes()


@pytest.fixture
def store(tmp_path, made):
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    tracking.root.mkdir()
    (tracking.root / "mlflow.db").write_bytes(made)
    return tracking


def refused(tracking):
    """The error of a store, which comes soon and is one line."""
    start = time.monotonic()
    with pytest.raises(TrackingError) as raised:
        check_store(tracking)
    assert time.monotonic() - start < SOON_S
    assert raised.value.path and raised.value.fix
    assert "\n" not in str(raised.value)
    return raised.value


@pytest.mark.parametrize("name", ["a%41b", "what?", "50%aF"])
def test_a_path_that_mlflow_misreads_is_refused(name, tmp_path):
    refused(TrackingConfig(str(tmp_path / name)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["50% off", "a b#c;d&e", "ä'\"[x]"])
def test_any_other_path_serves(name, tmp_path, made):
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


def test_another_programs_database_is_refused(tmp_path):
    (tmp_path / "mlflow.db").write_text("no database, but a text that is longer than any header of one " * 5)
    refused(TrackingConfig(str(tmp_path)))


def test_a_store_of_another_version_of_mlflow_is_refused(store):
    with sqlite3.connect(store.root / "mlflow.db") as connection:
        connection.execute("UPDATE alembic_version SET version_num = '451aebb31d03'")
    connection.close()
    refused(store)


def test_a_disk_without_room_is_found_before_work_starts_and_can_be_read(tmp_path, made):
    with small_disk(tmp_path / "disk", 8 * 2**20) as disk:
        new = TrackingConfig(str(disk / "new"))
        old = TrackingConfig(str(disk / "old"))
        old.root.mkdir()
        (old.root / "mlflow.db").write_bytes(made)
        filler = fill(disk, leave=300_000)
        for tracking in (new, old):
            refused(tracking)
        assert not [*(disk / "new").rglob("*")]
        filler.unlink()
        with read_only(disk):
            for tracking in (new, old):
                refused(tracking)
            assert not list(finished_runs(old, "train"))
            assert [experiment.name for experiment in client(old).search_experiments()] == ["Default"]
        check_store(old)


MAKE = """
import sys
from wheretolook.tracking import start_run
from wheretolook.tracking import TrackingConfig
print("ready", flush=True)
sys.stdin.readline()
with start_run(TrackingConfig(sys.argv[1]), "a", "train", {"dataset": "d"}):
    pass
"""


def _starting(folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", MAKE, str(folder)], env=environment, text=True, **pipes)


@pytest.fixture
def begun():
    processes = []
    yield processes
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_two_first_runs_at_once_make_one_store(tmp_path, begun):
    begun += [_starting(tmp_path / "mlruns") for _ in range(3)]
    for process in begun:
        assert process.stdout.readline() == "ready\n"
    for process in begun:
        process.stdin.write("\n")
        process.stdin.flush()
    for process in begun:
        assert process.wait(120) == 0, process.stderr and process.stderr.read()
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    assert len(list(finished_runs(tracking, "train"))) == 3
    assert experiment_id(client(tracking), tracking, "train", "d")
    assert {path.name for path in tracking.root.iterdir()} <= {"mlflow.db", "artifacts"}
