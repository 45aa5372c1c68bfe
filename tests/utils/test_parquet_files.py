"""Parquet files that expand to gigabytes, or would overflow the stack, are refused before they do."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wheretolook.utils.parquet_files import read_parquet


def _giant_list(path: Path) -> None:
    """One row: a list of zeros."""
    n = 40_000_000
    column = pa.ListArray.from_arrays(pa.array([0, n], pa.int32()), pa.array(np.zeros(n, np.int32)))
    pq.write_table(pa.table({"rows": column}), path, compression="none", data_page_size=2**30, store_schema=False)


def _long_text(path: Path) -> None:
    """65,536 times the same 20 MB: a kilobyte."""
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(65536, np.int32)), pa.array(["x" * 20_000_000]))
    options = {"compression": "zstd", "store_schema": False, "dictionary_pagesize_limit": 2**30}
    pq.write_table(pa.table({"status": texts}), path, **options)


def _nested(path: Path, depth: int) -> None:
    """No rows of a column nested in so many groups."""

    def number(value: int) -> bytes:
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


BOMBS = [_giant_list, _long_text, lambda p: _nested(p, 100_000)]


@pytest.mark.parametrize("make", BOMBS)
def test_bombs_are_refused(make, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "a.parquet"
    make(path)
    before = pa.default_memory_pool().max_memory() or 0
    start = time.process_time()
    with pytest.raises(ValueError):
        read_parquet(path)
    assert time.process_time() - start < 5
    assert (pa.default_memory_pool().max_memory() or 0) < max(before, 2**30)


def test_what_pandas_writes_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 30_000
    table = pd.DataFrame({"method": rng.choice(["set", "bins"], n), "x": rng.normal(size=n), "n": np.arange(n)})
    table["task"] = table["method"].astype("category")
    table["none"] = None
    table["rows"] = [np.arange(i % 7, dtype=np.int32) for i in range(n)]
    for options in ({}, {"compression": None, "row_group_size": 4000}, {"use_dictionary": False}):
        table.to_parquet(tmp_path / "a.parquet", **options)
        pd.testing.assert_frame_equal(read_parquet(tmp_path / "a.parquet"), pd.read_parquet(tmp_path / "a.parquet"))
