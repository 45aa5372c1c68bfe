"""The same table from any engine, number of workers and size of shards, after an interruption, and from a cluster."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from localization.rooms import MappedRoom, file_bytes, label, times, wait_until
from wheretolook.localization import ray_engine
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import MANIFEST, LabelTask, label_scenes
from wheretolook.localization.shard import Shard
from wheretolook.utils.errors import SceneError

SLOW = pytest.mark.slow


@SLOW
@pytest.mark.parametrize(("workers", "shard_size"), [(2, 5), (1, 24), (4, 3)])
def test_workers_and_shards_do_not_change_the_table(
    room: MappedRoom, views: pd.DataFrame, expected: bytes, tmp_path: Path, workers: int, shard_size: int
) -> None:
    assert label(views, room, tmp_path / "shards", workers=workers, shard_size=shard_size) == expected
    assert not multiprocessing.active_children()


@SLOW
def test_a_run_that_was_left_goes_on_where_it_stopped(
    room: MappedRoom, views: pd.DataFrame, expected: bytes, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    first = LabelTask("first", room.job, views[:4], tmp_path / "first")
    second = LabelTask("second", room.job, views, tmp_path / "second")
    run = label_scenes([first, second], LabelConfig(workers=2, shard_size=4), progress=False)
    assert next(run).task is first
    run.close()
    assert not multiprocessing.active_children()
    finished = times(first.shards) | times(second.shards)

    request.getfixturevalue("in_this_process")
    again = label_scenes([first, second], LabelConfig(workers=1, shard_size=4), progress=False)
    scenes = {scene.task.name: scene for scene in again}
    assert list(scenes) == ["first", "second"]
    assert file_bytes(scenes["second"].table, tmp_path / "second") == expected
    assert finished.items() <= (times(first.shards) | times(second.shards)).items()
    manifest = scenes["second"].manifest
    assert list(manifest["shards"]) == [path.name for path in times(second.shards)]
    assert (second.shards / MANIFEST).is_file()


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes of one core each, on this machine."""
    pytest.importorskip("ray")
    import ray
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20, "include_dashboard": False}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # where the nodes' workers find the package
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        cluster = Cluster(initialize_head=True, head_node_args=node)
        try:
            cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20)
            yield cluster
        finally:
            ray.shutdown()
            cluster.shutdown()


@SLOW
def test_a_cluster_gives_the_same_table(
    cluster: Any, room: MappedRoom, views: pd.DataFrame, expected: bytes, tmp_path: Path
) -> None:
    """The engine connects to the cluster and disconnects again, also after an error."""
    import ray

    config = {"engine": "ray", "ray_address": cluster.address, "shard_size": 3}
    assert label(views, room, tmp_path / "shards", **config) == expected
    assert not ray.is_initialized()

    broken = MappedRoom(tmp_path / "broken.glb", room.landmarks)
    broken.mesh.write_bytes(b"no mesh")
    with pytest.raises(SceneError):
        label(views, broken, tmp_path / "others", **config)
    assert not ray.is_initialized()


@SLOW
def test_a_machine_that_is_removed_loses_nothing(
    cluster: Any, room: MappedRoom, views: pd.DataFrame, expected: bytes, tmp_path: Path
) -> None:
    import ray

    ray.init(address=cluster.address, log_to_driver=False)
    task = LabelTask("room", room.job, views, tmp_path / "shards")

    def removing(shards: list[Shard], address: str):  # type: ignore[no-untyped-def]
        for number, result in enumerate(ray_engine_run(shards, address)):
            if number == 0:
                cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
            yield result

    with pytest.MonkeyPatch.context() as patch:
        ray_engine_run = ray_engine.run_ray
        patch.setattr(ray_engine, "run_ray", removing)
        (scene,) = label_scenes([task], LabelConfig(engine="ray", shard_size=2), progress=False)
    assert file_bytes(scene.table, tmp_path / "shards") == expected
    wait_until(lambda: sum(node["Alive"] for node in ray.nodes()) == 1)  # the head, and it alone
    assert ray.is_initialized()  # as it found it
