"""Parquet files that would overflow the stack are refused, and those that pandas writes are read."""

import struct
import time

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from wheretolook.utils.files import read_parquet


def _nested(path, depth):
    """No rows of a column nested in so many groups."""

    def number(value):
        parts = []
        while value >= 0x80:
            parts.append(value & 0x7F | 0x80)
            value >>= 7
        return bytes([*parts, value])

    group = b"\x35\x00\x18\x01a\x15\x02\x00"
    column = b"\x15\x02\x25\x00\x18\x01a\x00"
    columns = b"\x19\xfc" + number(depth + 2) + b"\x48\x01r\x15\x02\x00" + group * depth + column
    description = b"\x15\x02" + columns + b"\x16\x00\x19\x0c\x00"
    path.write_bytes(b"PAR1" + description + struct.pack("<I", len(description)) + b"PAR1")


def test_deeply_nested_columns_are_refused(tmp_path):
    path = tmp_path / "a.parquet"
    _nested(path, 100_000)
    before = pa.default_memory_pool().max_memory() or 0
    start = time.process_time()
    with pytest.raises(ValueError):
        read_parquet(path)
    assert time.process_time() - start < 5
    assert (pa.default_memory_pool().max_memory() or 0) < max(before, 2**30)


def test_what_pandas_writes_is_read(tmp_path):
    rng = np.random.default_rng(0)
    n = 30_000
    table = pd.DataFrame({"method": rng.choice(["set", "bins"], n), "x": rng.normal(size=n), "n": np.arange(n)})
    table["task"] = table["method"].astype("category")
    table["none"] = None
    table["rows"] = [np.arange(i % 7, dtype=np.int32) for i in range(n)]
    for options in ({}, {"compression": None, "row_group_size": 4000}, {"use_dictionary": False}):
        table.to_parquet(tmp_path / "a.parquet", **options)
        pd.testing.assert_frame_equal(read_parquet(tmp_path / "a.parquet"), pd.read_parquet(tmp_path / "a.parquet"))
