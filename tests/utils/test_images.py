"""Images that unfold to gigabytes are refused before they do."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from wheretolook.mapping.depth_images import read_depth
from wheretolook.mapping.photographs import read_photograph
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import image_size, read_image


def png(path, side):
    """A black square PNG, of which only the first row is there."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1 + side))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    return path


def test_a_bomb_is_refused_by_its_size(tmp_path):
    path = png(tmp_path / "a.png", 32_000)
    with pytest.raises(MapError):
        read_photograph(path)
    with pytest.raises(ValueError):
        read_depth(path)


def test_images_are_read_as_they_are(tmp_path):
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
    cv2.imwrite(str(tmp_path / "a.png"), depth)
    assert image_size(tmp_path / "a.png") == (4, 3)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", cv2.IMREAD_UNCHANGED), depth)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:40])
    cv2.imwrite(str(tmp_path / "a.jpg"), np.random.default_rng(0).integers(0, 255, (99, 99), np.uint8))
    whole = (tmp_path / "a.jpg").read_bytes()
    thumbnail = b"\xff\xe1" + (len(whole) + 2).to_bytes(2, "big") + whole
    padded = whole[:2] + thumbnail + b"\xff\xff" + whole[2:] + bytes(100)  # a marker may have fill bytes in front
    (tmp_path / "c.jpg").write_bytes(padded)
    assert read_image(tmp_path / "c.jpg", cv2.IMREAD_UNCHANGED).shape == (99, 99)
    (tmp_path / "d.jpg").write_bytes(padded[:-200])
    for path in (
        tmp_path / "b.png",
        tmp_path / "d.jpg",
        tmp_path,
        Path("/dev/zero"),
        tmp_path / "no.png",
        tmp_path / "n\0.png",
    ):
        with pytest.raises((ValueError, OSError)):
            read_image(path, cv2.IMREAD_UNCHANGED)
