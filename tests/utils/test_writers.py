"""Every writer of a file, on a disk that fails: the error names the file, no part of it stays, what was there does."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure
from tests.box_scenes import furnished_room
from tests.disks import file_limit, fill, read_only, small_disk
from tests.synthetic_dataset import CAMERA, make_mapping_poses

from wheretolook.dataset.viewpoint_files import SCHEMA, write_table
from wheretolook.figures.floor_plan import save_figure
from wheretolook.mapping.colmap_model import colmap_poses, write_model
from wheretolook.scenes.loading import save_glb
from wheretolook.training.weights import write_weights
from wheretolook.utils.errors import StorageError
from wheretolook.utils.files import copy_file, save_npy, save_npz, write_text
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.figures.animation import save_moving

RNG = np.random.default_rng(0)
NOISE = RNG.random(30_000)
LIMIT = 8192  # all that is written is larger


def _figure(path):
    figure = Figure()
    figure.subplots().plot(NOISE[:3000])
    save_figure(figure, path)


def _film(path):
    save_moving(iter(RNG.integers(0, 255, (4, 120, 160, 3), np.uint8)), 125, path)


def _table(path):
    columns = {field.name: NOISE[:4000] for field in SCHEMA if field.name != "status"}
    types = {field.name: field.type.to_pandas_dtype() for field in SCHEMA if field.name != "status"}
    write_table(pd.DataFrame({**columns, "status": "localized"}).astype(types), path)


def _occlusion(path):
    StoredOcclusion.from_mask(RNG.random((400, 3)), RNG.random((400, 500)) < 0.5).save(path)


WRITERS = {
    "a.txt": lambda path: write_text(path, "text " * 10_000),
    "copy.py": lambda path: copy_file(Path(pd.__file__).with_name("conftest.py"), path),
    "a.npz": lambda path: save_npz(path, {"noise": NOISE, "more": NOISE}),
    "a.npy": lambda path: save_npy(path, NOISE),
    "occlusion.npz": _occlusion,
    "viewpoints.parquet": _table,
    "a.safetensors": lambda path: write_weights(path, "mlp-2d", {"w": torch.from_numpy(NOISE)}, {}),
    "a.png": _figure,
    "a.mp4": _film,
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


def _model(n_images):  # a pycolmap.Reconstruction
    import pycolmap

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **CAMERA.colmap.record()))
    for number, pose in enumerate(make_mapping_poses(0, n_images), 1):
        image = pycolmap.Image(name=f"{number:05d}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    return model


def test_a_model_that_colmap_wrote_in_part_is_an_error(tmp_path):
    model = _model(400)
    write_model(model, tmp_path / "whole")
    assert len(colmap_poses(tmp_path / "whole")) == 400
    with file_limit(LIMIT), pytest.raises(StorageError) as raised:
        write_model(model, tmp_path / "part")
    assert raised.value.path == tmp_path / "part" / "images.bin"
