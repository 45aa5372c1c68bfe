"""Every writer of a file, on a disk that fails: the error names the file, no part of it stays, what was there does."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure
from tests.box_scenes import furnished_room
from tests.disks import file_limit, fill, read_only, small_disk
from tests.synthetic_dataset import CAMERA, make_landmarks, make_mapping_poses

from wheretolook.dataset.viewpoint_table import SCHEMA, write_table
from wheretolook.figures.animation import save_moving
from wheretolook.figures.style import save_figure
from wheretolook.mapping.colmap_model import colmap_poses, save_mapping_poses, write_model
from wheretolook.mapping.triangulation import fill_database
from wheretolook.scenes.loading import save_glb
from wheretolook.training.weights import write_weights
from wheretolook.utils.colmap import storing_in_database
from wheretolook.utils.errors import StorageError
from wheretolook.utils.files import atomic_folder, atomic_write, copy_file, write_bytes, write_json, write_text
from wheretolook.utils.npz_files import load_npy, load_npz, save_npy, save_npz
from wheretolook.visibility.occlusion import StoredOcclusion

RNG = np.random.default_rng(0)
NOISE = RNG.random(30_000)
LIMIT = 8192  # all that is written is larger


def _figure(path: Path) -> None:
    figure = Figure()
    figure.subplots().plot(NOISE[:3000])
    save_figure(figure, path)


def _film(path: Path) -> None:
    save_moving(iter(RNG.integers(0, 255, (4, 120, 160, 3), np.uint8)), 125, path)


def _table(path: Path) -> None:
    columns = {field.name: NOISE[:4000] for field in SCHEMA if field.name != "status"}
    types = {field.name: field.type.to_pandas_dtype() for field in SCHEMA if field.name != "status"}
    write_table(pd.DataFrame({**columns, "status": "localized"}).astype(types), path)


def _any_parquet(path: Path) -> None:
    with atomic_write(path) as partial:
        pd.DataFrame({"noise": NOISE}).to_parquet(partial)


def _occlusion(path: Path) -> None:
    StoredOcclusion.from_mask(RNG.random((400, 3)), RNG.random((400, 500)) < 0.5).save(path)


WRITERS: dict[str, Callable[[Path], None]] = {
    "a.txt": lambda path: write_text(path, "text " * 10_000),
    "a.json": lambda path: write_json(path, NOISE.tolist()),
    "a.bin": lambda path: write_bytes(path, NOISE.tobytes()),
    "copy.py": lambda path: copy_file(Path(pd.__file__).with_name("conftest.py"), path),
    "a.npz": lambda path: save_npz(path, {"noise": NOISE, "more": NOISE}),
    "packed.npz": lambda path: save_npz(path, {"noise": NOISE, "more": NOISE}, compress=True),
    "a.npy": lambda path: save_npy(path, NOISE),
    "landmarks.npz": lambda path: make_landmarks(RNG, 2000).save(path),
    "occlusion.npz": _occlusion,
    "cameras.npz": lambda path: save_mapping_poses(make_mapping_poses(0, 500), path),
    "viewpoints.parquet": _table,
    "any.parquet": _any_parquet,
    "a.safetensors": lambda path: write_weights(path, "mlp-2d", {"w": torch.from_numpy(NOISE)}, {}),
    "a.png": _figure,
    "a.pdf": _figure,
    "a.svg": _figure,
    "a.gif": _film,
    "a.mp4": _film,
    "mesh.glb": lambda path: save_glb(furnished_room(), path),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("disk", ["limited", "full", "read-only"])
def test_a_writer_that_fails_names_the_file_and_leaves_no_part(name: str, disk: str, tmp_path: Path) -> None:
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
            assert raised.value.path == target and raised.value.fix
            assert [*target.parent.iterdir()] == ([path] if target == path else [])
        assert path.read_bytes() == before


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError) as raised:
        write_text(tmp_path / "file" / "deep" / "a.txt", "a")
    assert str(raised.value.path).startswith(str(tmp_path / "file"))


def test_a_copy_whose_source_is_missing_names_the_source(tmp_path: Path) -> None:
    (tmp_path / "b").write_text("old")
    with pytest.raises(FileNotFoundError) as raised:
        copy_file(tmp_path / "a", tmp_path / "b")
    assert raised.value.filename == str(tmp_path / "a")
    assert (tmp_path / "b").read_text() == "old"


def test_arrays_are_read_back_as_they_were(tmp_path: Path) -> None:
    save_npy(tmp_path / "a.npy", NOISE.reshape(3, -1))
    np.testing.assert_array_equal(load_npy(tmp_path / "a.npy"), NOISE.reshape(3, -1))
    np.save(tmp_path / "b.npy", NOISE.reshape(3, -1))
    assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()
    save_npz(tmp_path / "a.npz", {"x": NOISE})
    np.testing.assert_array_equal(load_npz(tmp_path / "a.npz")["x"], NOISE)


def _model(n_images: int):  # type: ignore[no-untyped-def]  # a pycolmap.Reconstruction
    import pycolmap

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **CAMERA.colmap.record()))
    for number, pose in enumerate(make_mapping_poses(0, n_images), 1):
        image = pycolmap.Image(name=f"{number:05d}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    return model


def test_a_model_that_colmap_wrote_in_part_is_an_error(tmp_path: Path) -> None:
    model = _model(400)
    write_model(model, tmp_path / "whole")
    assert len(colmap_poses(tmp_path / "whole")) == 400
    with file_limit(LIMIT), pytest.raises(StorageError) as raised:
        write_model(model, tmp_path / "part")
    assert raised.value.path == tmp_path / "part" / "images.bin"


@pytest.mark.parametrize("limit", [1000, 100_000, 400_000])
def test_a_database_that_colmap_cannot_write_is_named(limit: int, tmp_path: Path) -> None:
    database = tmp_path / "database.db"
    stored = [(RNG.random((4000, 2)).astype(np.float32), np.zeros((4000, 128), np.uint8)) for _ in range(4)]
    failing = pytest.raises(StorageError)
    with file_limit(limit), failing as raised, storing_in_database(database):
        fill_database(database, _model(4), stored)
    assert raised.value.path == database


def test_a_folder_that_is_moved_later_is_named_as_it_was_to_be(tmp_path: Path) -> None:
    place = tmp_path / "map"
    limited = file_limit(LIMIT)
    with pytest.raises(StorageError) as raised, limited, atomic_folder(place) as partial:
        write_bytes(partial / "deep" / "a.bin", NOISE.tobytes())
    assert raised.value.path == place / "deep" / "a.bin" and not list(tmp_path.iterdir())
