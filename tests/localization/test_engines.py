"""The same table from any engine, number of workers and size of shards, after an interruption, and from a cluster."""

import multiprocessing
import os
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from localization.rooms import MappedRoom, label
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import LabelTask, label_scenes
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.utils.errors import SceneError

SLOW = pytest.mark.slow


@SLOW
@pytest.mark.parametrize(("workers", "shard_size"), [(2, 5), (1, 24), (4, 3)])
def test_workers_and_shards_do_not_change_the_table(room, views, expected, tmp_path, workers, shard_size):
    assert label(views, room, tmp_path / "shards", workers=workers, shard_size=shard_size) == expected
    assert not multiprocessing.active_children()


@SLOW
def test_workers_do_not_change_appearances(room, views, tmp_path):
    one, three = (
        label(views, room, tmp_path / str(workers), workers=workers, shard_size=24 // workers, appearance=0.7)
        for workers in (1, 3)
    )
    assert one == three


@pytest.fixture(scope="module")
def cluster():
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
def test_a_cluster_gives_the_same_table(cluster, room, views, expected, tmp_path):
    """The engine connects to the cluster and disconnects again, also after an error."""
    import ray

    config = {"engine": "ray", "ray_address": cluster.address, "shard_size": 3}
    assert label(views, room, tmp_path / "shards", **config) == expected
    assert not ray.is_initialized()

    mesh = load_mesh(room.mesh)
    plain = replace(mesh, textures=tuple(np.full_like(texture, 128) for texture in mesh.textures))
    save_glb(plain, tmp_path / "changed.glb")
    job = replace(room.job, changes=0.5, changed_mesh=tmp_path / "changed.glb")
    located = views.assign(location_id=np.arange(len(views), dtype=np.int32))
    tables = []
    for engine in (LabelConfig(**config), LabelConfig(workers=1)):
        task = LabelTask("room", job, located, tmp_path / engine.engine)
        (scene,) = label_scenes([task], engine, progress=False)
        tables.append(scene.table)
    pd.testing.assert_frame_equal(*tables)
    assert tables[0]["changes"].nunique() == 2

    broken = MappedRoom(tmp_path / "broken.glb", room.landmarks)
    broken.mesh.write_bytes(b"no mesh")
    with pytest.raises(SceneError):
        label(views, broken, tmp_path / "others", **config)
    assert not ray.is_initialized()
