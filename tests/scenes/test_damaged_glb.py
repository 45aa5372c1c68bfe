"""GLB files that are damaged or lie: a typed error that names the file, at once, and little memory."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import wheretolook
from box_scenes import random_texture
from scenes.test_loading import textured
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import SceneError


@pytest.fixture
def whole(tmp_path):
    textured(random_texture(np.random.default_rng(0), 4, 6)).export(tmp_path / "a.glb")
    return tmp_path / "a.glb"


def rewrite(path, change):
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    tree = change(json.loads(content[20 : 20 + length]))
    chunk = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    chunk += b" " * (-len(chunk) % 4)
    rest = content[20 + length :]
    header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(chunk) + len(rest), len(chunk), 0x4E4F534A)
    path.write_bytes(header + chunk + rest)


def accessor(count, view):
    def change(tree):
        tree["accessors"][0]["count"] = count
        if not view:
            tree["accessors"][0].pop("bufferView")
        return tree

    return change


def nested(tree):
    n = 100_000
    tree["nodes"] = [{"children": [i + 1]} for i in range(n)] + [{"mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]
    return tree


def few_uvs(tree):
    at = tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    tree["accessors"][at]["count"] = 2
    return tree


CHANGES = [accessor(count, view) for count in (0, -1, 300_000_000, None) for view in (False, True)]
CHANGES += [nested, few_uvs, lambda tree: None, lambda tree: {**tree, "accessors": None}, lambda tree: b"[" * 100_000]


@pytest.mark.parametrize("change", CHANGES)
def test_lies_are_refused(whole, change):
    rewrite(whole, change)
    with pytest.raises(SceneError) as caught:
        load_mesh(whole)
    assert caught.value.path == whole


def test_a_texture_that_cannot_be_opened_is_not_taken_for_none(whole):
    content = whole.read_bytes()
    assert content.count(b"\x89PNG") == 1
    whole.write_bytes(content.replace(b"\x89PNG", b"\x00PNG"))
    with pytest.raises(SceneError, match="texture 0 is damaged"):
        load_mesh(whole)


FLIPS = """
import random, resource, sys, warnings
from pathlib import Path
import numpy as np
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import SceneError
resource.setrlimit(resource.RLIMIT_AS, (4 << 30,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
warnings.simplefilter("ignore")
draw, path, said = random.Random(21), Path(sys.argv[1]), [0, 0]
whole = path.read_bytes()
for _ in range(400):
    bit = draw.randrange(8 * len(whole))
    flipped = bytearray(whole)
    flipped[bit // 8] ^= 1 << bit % 8
    path.write_bytes(flipped)
    try:
        assert np.isfinite(load_mesh(path).vertices).all()
        said[0] += 1
    except SceneError as error:
        assert Path(error.path) == path, (bit, error)
        said[1] += 1
    except Exception as error:
        raise AssertionError(bit) from error
print(*said)
"""


def test_flipped_bits_are_typed_errors_or_numbers(whole):
    env = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", FLIPS, str(whole)], capture_output=True, text=True, timeout=120, env=env
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert min(map(int, done.stdout.split())) > 50
