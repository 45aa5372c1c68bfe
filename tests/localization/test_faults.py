"""Faults at each step of labelling lead to the same table, possibly after resuming, or to a typed error."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading

import pyarrow.parquet as pq
import pytest

from localization.rooms import Deadly, MappedRoom, is_running, label, times, workers_of
from waiting import wait_until
from wheretolook.dataset.viewpoint_files import read_table, write_table
from wheretolook.localization import labeller
from wheretolook.localization.shard import Shard, run_local
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.utils.errors import WorkerError


@pytest.mark.slow
def test_killed_workers_are_replaced(room, views, expected, tmp_path, monkeypatch):
    """One is killed while it starts, one when the first shard is finished."""
    killed = set()

    def kill_one():
        victim = workers_of(os.getpid())[0]
        os.kill(victim, signal.SIGKILL)
        killed.add(victim)

    def watched(shards, workers):
        for number, result in enumerate(run_local(shards, workers)):
            if number == 0:
                kill_one()
            yield result

    def kill_at_start():
        wait_until(lambda: len(workers_of(os.getpid())) == 2)
        kill_one()

    monkeypatch.setattr(labeller, "run_local", watched)
    killer = threading.Thread(target=kill_at_start)
    killer.start()
    assert label(views, room, tmp_path / "shards", workers=2, shard_size=6) == expected
    killer.join()
    assert len(killed) == 2
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_shard_that_kills_its_worker_every_time_is_given_up(room, views, tmp_path):
    rows = views[:2]
    good = Shard(room.job, tmp_path / "a", rows)
    deadly = Shard(room.job, tmp_path / "b", Deadly())
    run = run_local([good, deadly], workers=1)
    shard, labelled = next(run)
    assert shard is good and len(labelled.rows) == 2
    with pytest.raises(WorkerError):
        next(run)
    assert not multiprocessing.active_children()


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_damaged_shards_are_made_anew_and_no_others(room, views, expected, tmp_path):
    label(views, room, tmp_path, shard_size=4)
    truncated, flipped, empty, swapped, *_ = paths = list(times(tmp_path))
    truncated.write_bytes(truncated.read_bytes()[:-100])
    flipped.write_bytes(with_flipped_bit(flipped.read_bytes(), inside_a_page(flipped)))
    empty.write_bytes(b"")
    swapped.write_bytes(paths[-1].read_bytes())
    before = times(tmp_path)
    assert label(views, room, tmp_path, shard_size=4) == expected
    after = times(tmp_path)
    assert [path for path in after if after[path] != before[path]] == [truncated, flipped, empty, swapped]


@pytest.mark.usefixtures("in_this_process")
def test_shards_of_another_mesh_or_of_other_viewpoints_are_not_used(room, views, tmp_path):
    mesh = tmp_path / "mesh.glb"
    mesh.write_bytes(room.mesh.read_bytes())
    copy = MappedRoom(mesh, room.landmarks)
    table = views[:6]
    label(table, copy, tmp_path / "shards", shard_size=3)

    counted = table.assign(n_visible=7)
    label(counted, copy, tmp_path / "shards", shard_size=3)
    assert (read_table(tmp_path / "shards-labelled.parquet")["n_visible"] == 7).all()

    bare = load_mesh(room.mesh)
    for texture in bare.textures:
        texture[:] = 200
    save_glb(bare, mesh)
    label(table, copy, tmp_path / "shards", shard_size=3)
    assert (read_table(tmp_path / "shards-labelled.parquet")["status"] == "too_few_matches").all()


@pytest.mark.slow
def test_killed_at_any_moment_it_resumes_to_the_same_table(room, views, expected_matches, tmp_path, request):
    write_table(views, tmp_path / "table.parquet")
    script = tmp_path / "run.py"
    script.write_text(
        "import sys\nfrom pathlib import Path\n"
        "from localization.rooms import MappedRoom, label\n"
        "from wheretolook.dataset.viewpoint_files import read_table\n"
        "if __name__ == '__main__':\n"
        "    folder, mesh, landmarks = map(Path, sys.argv[1:])\n"
        "    table = read_table(folder / 'table.parquet')\n"
        "    options = dict(workers=2, shard_size=2, store_matches=True)\n"
        "    label(table, MappedRoom(mesh, landmarks), folder / 'shards', **options)\n"
    )
    run = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path), str(room.mesh), str(room.landmarks)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    wait_until(lambda: len(workers_of(run.pid)) == 2 and len(times(tmp_path / "shards")) >= 3)
    workers = workers_of(run.pid)
    run.send_signal(signal.SIGKILL)
    run.wait()
    finished = times(tmp_path / "shards")
    assert 3 <= len(finished) < 12
    wait_until(lambda: not any(map(is_running, workers)), seconds=30)  # they do not outlive it
    assert times(tmp_path / "shards") == finished

    request.getfixturevalue("in_this_process")
    labelled = label(views, room, tmp_path / "shards", shard_size=2, store_matches=True)
    assert labelled == expected_matches
    assert finished.items() <= times(tmp_path / "shards").items()


def with_flipped_bit(content, place, bit=0):
    flipped = bytearray(content)
    flipped[place] ^= 1 << bit
    return bytes(flipped)


def inside_a_page(path):
    """The bit is in the translations, which are not compressed: only the checksum reveals the change."""
    return int(pq.ParquetFile(path).metadata.row_group(0).column(7).data_page_offset) - 4  # its dictionary's last value
