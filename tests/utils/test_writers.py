"""Every writer of a file, on a disk that fails: the error names the file, no part of it stays, what was there does."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure

from box_scenes import furnished_room
from colmap_models import camera, model_of
from disks import file_limit, fill, read_only, small_disk
from synthetic_dataset import make_mapping_poses
from wheretolook.dataset.viewpoint_files import SCHEMA, write_table
from wheretolook.figures.floor_plan import save_figure
from wheretolook.mapping.colmap_model import colmap_poses, write_model
from wheretolook.scenes.loading import save_glb
from wheretolook.training.weights import write_weights
from wheretolook.utils.errors import StorageError
from wheretolook.utils.files import copy_file, save_npy, save_npz, write_text

RNG = np.random.default_rng(0)
NOISE = RNG.random(30_000)
LIMIT = 8192  # all that is written is larger


def _figure(path):
    figure = Figure()
    figure.subplots().plot(NOISE[:3000])
    save_figure(figure, path)


def _table(path):
    columns = {field.name: NOISE[:4000] for field in SCHEMA if field.name != "status"}
    types = {field.name: field.type.to_pandas_dtype() for field in SCHEMA if field.name != "status"}
    write_table(pd.DataFrame({**columns, "status": "localized"}).astype(types), path)


WRITERS = {
    "a.txt": lambda path: write_text(path, "text " * 10_000),
    "copy.py": lambda path: copy_file(Path(pd.__file__).with_name("conftest.py"), path),
    "a.npz": lambda path: save_npz(path, {"noise": NOISE, "more": NOISE}),
    "a.npy": lambda path: save_npy(path, NOISE),
    "viewpoints.parquet": _table,
    "a.safetensors": lambda path: write_weights(path, "mlp-2d", {"w": torch.from_numpy(NOISE)}, {}),
    "a.png": _figure,
    "mesh.glb": lambda path: save_glb(furnished_room(), path),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("disk", ["limited", "full", "read-only"])
def test_a_writer_that_fails_names_the_file_and_leaves_no_part(name, disk, tmp_path):
    write = WRITERS[name]
    with ExitStack() as stack:
        folder = tmp_path / "disk"
        if disk == "limited":
            folder.mkdir()
        else:
            stack.enter_context(small_disk(folder, 10 * 2**20))
        path = folder / "there" / name
        write(path)  # it can be written
        before = path.read_bytes()
        others = sorted(path.parent.iterdir())
        assert len(before) > LIMIT and others == [path]
        write(folder / "new" / name)
        (folder / "new" / name).unlink()
        if disk == "limited":
            stack.enter_context(file_limit(LIMIT))
        elif disk == "full":
            fill(folder, leave=LIMIT)
        else:
            stack.enter_context(read_only(folder))
        for target in (path, folder / "new" / name):
            with pytest.raises(StorageError) as raised:
                write(target)
            assert raised.value.path == target
            assert [*target.parent.iterdir()] == ([path] if target == path else [])
        assert path.read_bytes() == before


def test_a_model_that_colmap_wrote_in_part_is_an_error(tmp_path):
    images = [(f"{row:05d}.png", 1, pose, np.zeros((0, 2))) for row, pose in enumerate(make_mapping_poses(0, 400))]
    model = model_of([camera(1, "PINHOLE", 160, 120, 80, 80, 80, 60)], images)
    write_model(model, tmp_path / "whole")
    assert len(colmap_poses(tmp_path / "whole")) == 400
    with file_limit(LIMIT), pytest.raises(StorageError) as raised:
        write_model(model, tmp_path / "part")
    assert raised.value.path == tmp_path / "part" / "images.bin"
