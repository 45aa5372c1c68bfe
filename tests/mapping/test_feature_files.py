"""Files of features that do not fit the model, are damaged, or were made to do harm."""

import sqlite3
import time

import numpy as np
import pytest

from mapping.test_landmarks import hand_written_model, random_descriptors, write_database
from mapping.test_learned_features import database_of, hdf5_of, unit
from wheretolook.features.extractor import KINDS
from wheretolook.mapping.colmap_model import model_arrays
from wheretolook.mapping.feature_files import read_descriptors, read_features
from wheretolook.utils.errors import MapError

MODEL, KEYPOINTS = hand_written_model()
ARRAYS = model_arrays(MODEL)
DESCRIPTORS = random_descriptors([len(pixels) for pixels in KEYPOINTS])
ALIKED = KINDS["aliked"]
LEARNED = [ALIKED.store(unit(len(pixels), ALIKED.dimension, seed)) for seed, pixels in enumerate(KEYPOINTS)]
N = len(KEYPOINTS[0])
COUNT = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT"  # without end


def replaced(name="keypoints", **dataset):
    """An edit that puts another array in the place of an image's."""

    def edit(h5py, file):
        del file[f"0.png/{name}"]
        file.create_dataset(f"0.png/{name}", **dataset)

    return edit


def link(h5py, file):
    del file["0.png"]
    file["0.png"] = h5py.ExternalLink("other.h5", "/0.png")


def soft_link(h5py, file):
    link(h5py, file)
    file.move("0.png", "away")
    file["0.png"] = h5py.SoftLink("/away")


def virtual(h5py, file):
    layout = h5py.VirtualLayout(shape=(N, 2), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "0.png/keypoints", shape=layout.shape)
    del file["0.png/keypoints"]
    file.create_virtual_dataset("0.png/keypoints", layout)


@pytest.mark.parametrize(
    "edit",
    [
        replaced(shape=(2**30, 2), dtype="f8", chunks=(1024, 2)),  # 16 GB
        replaced("descriptors", shape=(128, 12_000_000), dtype="f2", chunks=(128, 1024)),
        replaced(shape=(N, 2), maxshape=(None, 2), dtype="f8", chunks=(2**27, 2)),
        link,
        soft_link,
        replaced(shape=(N, 2), dtype="f8", external=[("secret", 0, N * 16)]),
        virtual,
        replaced(data=np.full((N, 2), np.nan)),
        replaced("descriptors", data=np.full((128, N), np.nan)),
        replaced("descriptors", data=np.zeros((64, N))),
        replaced("descriptors", data=np.zeros((128, N - 1))),
        replaced(data=KEYPOINTS[0][:, :1]),
        replaced(data=KEYPOINTS[0][:-1]),
        lambda h5py, file: file.pop("0.png"),
        lambda h5py, file: file["0.png"].pop("descriptors"),
    ],
)
def test_invalid_hdf5_is_rejected(edit, tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)
    hdf5_of(tmp_path / "other.h5", KEYPOINTS, LEARNED)
    (tmp_path / "secret").write_bytes((KEYPOINTS[0] - 0.5).tobytes())
    path = hdf5_of(tmp_path / "feats-aliked.h5", KEYPOINTS, LEARNED)
    with h5py.File(path, "a") as file:
        edit(h5py, file)
    with pytest.raises(MapError) as caught:
        read_descriptors(path, MODEL, ARRAYS)
    assert caught.value.path == path


def test_time_does_not_grow_with_the_links_of_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = hdf5_of(tmp_path / "feats-aliked.h5", KEYPOINTS, LEARNED)
    with h5py.File(path, "a", libver="latest") as file:
        empty = file.create_group("others").id
        for number in range(20_000):
            empty.links.create_hard(b"%d" % number, file["0.png"].id, b"keypoints")
    start = time.process_time()
    read_descriptors(path, MODEL, ARRAYS)
    assert time.process_time() - start < 1


RENAME = "ALTER TABLE keypoints RENAME TO away"
NANS = np.full((N, 2), np.nan, "<f4").tobytes().hex()
FLOATS = np.full((N, 128), 3e38, "<f4").tobytes().hex()


@pytest.mark.parametrize(
    "statements",
    [
        ["ALTER TABLE images RENAME TO away", f"CREATE VIEW images AS {COUNT} x AS image_id, 'n' AS name FROM c"],
        [
            RENAME,
            "CREATE VIEW keypoints AS SELECT image_id, 62500000 rows, 4 cols, zeroblob(1000000000) data FROM away",
        ],
        [
            RENAME,
            "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows, cols, data BLOB AS (zeroblob(900000000)))",
        ],
        ["DROP TABLE wheretolook_features", f"CREATE VIEW Wheretolook_Features AS {COUNT} x AS name FROM c"],
        [f"UPDATE keypoints SET rows = {N}, cols = 2, data = x'{NANS}'"],
        [f"UPDATE descriptors SET rows = {N}, cols = 512, type = {ALIKED.colmap_type}, data = x'{FLOATS}'"],
        ["UPDATE descriptors SET type = 0, cols = 128, data = substr(data, 1, 128 * rows) WHERE image_id = 2"],
        ["DELETE FROM descriptors WHERE image_id = 2"],
        ["DROP TABLE keypoints"],
        ["UPDATE keypoints SET rows = rows - 1, data = substr(data, 1, length(data) - 4 * cols)"],
    ],
)
def test_invalid_databases_are_rejected(statements, tmp_path):
    path = database_of(tmp_path / "a.db", MODEL, KEYPOINTS, LEARNED, ALIKED)
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    with pytest.raises(MapError) as caught:
        read_descriptors(path, MODEL, ARRAYS)
    assert caught.value.path == path


@pytest.mark.parametrize(
    ("name", "content"), [("a.db", None), ("a.db", b""), ("a.db", b"\x00garbage" * 999), ("feats.h5", b"not HDF5")]
)
def test_files_of_another_kind_are_rejected(name, content, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(MapError):
        read_features(tmp_path / name, ["0.png"])


def test_databases_of_other_keypoints_are_rejected(tmp_path):
    path = write_database(tmp_path / "moved.db", MODEL, [pixels + 3 for pixels in KEYPOINTS], DESCRIPTORS)
    with pytest.raises(MapError):
        read_descriptors(path, MODEL, ARRAYS)
