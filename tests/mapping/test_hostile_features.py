"""Features that are made to do harm: to fill memory, to keep a run for ever, to read other files."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from mapping.test_landmarks import hand_written_model, random_descriptors, write_database
from wheretolook.features.registry import all_kinds
from wheretolook.mapping.colmap_model import model_arrays
from wheretolook.mapping.feature_files import read_descriptors, read_features
from wheretolook.utils.errors import MapError

MODEL, KEYPOINTS = hand_written_model()
ARRAYS = model_arrays(MODEL)
DESCRIPTORS = random_descriptors([len(found) for found in KEYPOINTS])
COUNT = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT"  # without end


def hdf5(path: Path, edit) -> Path:
    h5py = pytest.importorskip("h5py", reason="hloc's features need h5py: pip install 'wheretolook[hloc]'")
    with h5py.File(path, "w") as file:
        for number, (points, descriptors) in enumerate(zip(KEYPOINTS, DESCRIPTORS, strict=True)):
            file[f"{number}.png/keypoints"] = points - 0.5
            file[f"{number}.png/descriptors"] = (descriptors / 512).T.astype(np.float16)
        edit(h5py, file)
    return path


def put(name: str = "keypoints", **about):
    """Puts another array into the first image's place."""

    def edit(_, file) -> None:
        del file[f"0.png/{name}"]
        file.create_dataset(f"0.png/{name}", **about)

    return edit


def link(h5py, file) -> None:
    del file["0.png"]
    file["0.png"] = h5py.ExternalLink("other.h5", "/0.png")


def virtual(h5py, file) -> None:
    layout = h5py.VirtualLayout(shape=(len(KEYPOINTS[0]), 2), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "0.png/keypoints", shape=layout.shape)
    del file["0.png/keypoints"]
    file.create_virtual_dataset("0.png/keypoints", layout)


N = len(KEYPOINTS[0])
HDF5 = {
    "16 GB of nothing": (put(shape=(2**30, 2), dtype="f8", chunks=(1024, 2)), "would unfold to"),
    "3 GB of nothing": (put("descriptors", shape=(128, 12_000_000), dtype="f2", chunks=(128, 1024)), "would unfold"),
    "a chunk of 3 GB": (put(shape=(N, 2), maxshape=(None, 2), dtype="f8", chunks=(2**27, 2)), "would unfold to"),
    "another file by a link": (link, "leads to another file"),
    "another file's bytes": (put(shape=(N, 2), dtype="f8", external=[("secret", 0, N * 16)]), "lie in another file"),
    "another file's array": (virtual, "lie in another file"),
    "texts": (put(data=np.array([[b"a", b"b"]] * N)), "no finite numbers"),
    "no numbers": (put(data=np.full((N, 2), np.nan)), "no finite numbers"),
    "descriptors that are no numbers": (put("descriptors", data=np.full((128, N), np.nan)), "no finite numbers"),
    "huge descriptors": (put("descriptors", data=np.full((256, N), 1e300)), "no finite numbers"),
    "one number": (put(data=3.0), "no finite numbers"),
    "nothing": (put(dtype="f8"), "no array"),
}


@pytest.mark.parametrize("what", HDF5)
def test_hostile_features_in_hdf5_are_refused(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    hdf5(tmp_path / "other.h5", lambda *_: None)
    (tmp_path / "secret").write_bytes((KEYPOINTS[0] - 0.5).tobytes())
    edit, told = HDF5[what]
    path = hdf5(tmp_path / "a.h5", edit)
    with pytest.raises(MapError, match=told) as caught:
        read_descriptors(path, "model", MODEL, ARRAYS)
    assert caught.value.path == path


NANS = np.full((N, 2), np.nan, "<f4").tobytes().hex()
AWAY = "ALTER TABLE keypoints RENAME TO away"
ENDLESS = f"CREATE VIEW images AS {COUNT} x AS image_id, 'n' AS name FROM c"
GIGABYTE = "CREATE VIEW keypoints AS SELECT image_id, 62500000 AS rows, 4 AS cols, zeroblob(1000000000) data FROM away"
COMPUTED = "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows, cols, data BLOB AS (zeroblob(900000000)))"
DATABASES = {
    "images without end": (["ALTER TABLE images RENAME TO away", ENDLESS], "images is a view"),
    "a gigabyte of nothing": ([AWAY, GIGABYTE], "keypoints is a view"),
    "a computed gigabyte": ([AWAY, COMPUTED], "computed columns"),
    "a kind without end": ([f"CREATE VIEW Wheretolook_Features AS {COUNT} x AS name FROM c"], "is a view"),
    "no numbers": ([f"UPDATE keypoints SET rows = {N}, cols = 2, data = x'{NANS}'"], "no finite numbers"),
    "too few of them": (["UPDATE keypoints SET rows = 9223372036854775807"], "cannot reshape"),
}


@pytest.mark.parametrize("what", DATABASES)
def test_hostile_databases_are_refused(what: str, tmp_path: Path) -> None:
    statements, told = DATABASES[what]
    path = write_database(tmp_path / "a.db", MODEL, KEYPOINTS, DESCRIPTORS)
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    with pytest.raises(MapError, match=told) as caught:
        read_descriptors(path, "model", MODEL, ARRAYS)
    assert caught.value.path == path


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
def test_learned_descriptors_of_no_numbers_are_refused(value: float, tmp_path: Path) -> None:
    kind = all_kinds()["aliked"]
    path = write_database(tmp_path / "a.db", MODEL, KEYPOINTS, DESCRIPTORS)
    connection = sqlite3.connect(path)
    if "type" not in {row[1] for row in connection.execute("PRAGMA table_info(descriptors)")}:
        connection.execute("ALTER TABLE descriptors ADD COLUMN type INTEGER")
    for number, n in connection.execute("SELECT image_id, rows FROM descriptors").fetchall():
        data = np.full((n, kind.dimension), value, dtype="<f4").tobytes()
        row = (kind.columns, data, kind.colmap_type, number)
        connection.execute("UPDATE descriptors SET cols = ?, data = ?, type = ? WHERE image_id = ?", row)
    connection.commit()
    connection.close()
    with pytest.raises(MapError, match="no finite numbers"):
        read_features(path, ["0.png"])
