"""Weights by a path, a folder, or a name on the Hugging Face hub, from a folder laid out as the hub's cache."""

import pytest

from selection.room import WEIGHTS, write_room
from wheretolook.scorers.weights import resolve_weights
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import WeightsError

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Return the folder of a snapshot: files are links to blobs, and refs/main holds the commit."""
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    repository = tmp_path / "home" / "hub" / "models--lab--where-to.look"
    snapshot = repository / "snapshots" / COMMIT
    for folder in (snapshot, repository / "refs", repository / "blobs"):
        folder.mkdir(parents=True)
    (repository / "refs" / "main").write_text(COMMIT)
    for number, name in enumerate(("set.safetensors", "set.json", "mlp-2d+z.safetensors", "mlp-2d+z.json")):
        blob = repository / "blobs" / str(number)
        blob.write_bytes((WEIGHTS / name).read_bytes())
        (snapshot / name).symlink_to(blob)
    return snapshot


def test_a_name_is_found_in_the_cache(cache, tmp_path):
    assert resolve_weights(path="lab/where-to.look") == cache / "set.safetensors"
    assert resolve_weights("mlp-2d+z", "lab/where-to.look") == cache / "mlp-2d+z.safetensors"
    assert resolve_weights(path=cache) == cache / "set.safetensors"
    sparse = write_room(tmp_path / "sparse")
    options = {"directions": 20, "device": "cpu"}
    poses = WhereToLook.from_colmap(sparse, weights=WEIGHTS, **options).best([(2.0, 2.0, 1.5)])
    again = WhereToLook.from_colmap(sparse, weights="lab/where-to.look", **options).best([(2.0, 2.0, 1.5)])
    assert again.score == poses.score


def test_the_cache_may_be_elsewhere(cache, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "home" / "hub"))
    monkeypatch.setenv("HF_HOME", str(tmp_path / "other"))
    assert resolve_weights(path="lab/where-to.look") == cache / "set.safetensors"


@pytest.mark.parametrize("name", ["lab/nothing", "nobody/nothing", "lab/where-to.look"])
def test_what_is_neither_here_nor_on_the_hub(cache, name):
    for path in cache.glob("*.safetensors"):  # such as after a download of the card alone
        path.unlink()
    with pytest.raises(WeightsError, match="not on the hub"):
        resolve_weights(path=name)


def test_a_folder_of_this_name_comes_first(cache, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab" / "where-to.look").mkdir(parents=True)
    with pytest.raises(WeightsError, match="no weights of"):
        resolve_weights(path="lab/where-to.look")
