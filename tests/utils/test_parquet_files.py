"""Parquet files that unfold to gigabytes, or would overflow the stack, are refused before they do."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wheretolook.dataset.viewpoint_table import has_matches
from wheretolook.utils import parquet_files
from wheretolook.utils.parquet_files import read_parquet


def _list(n: int, path: Path) -> None:
    """One row: a list of zeros."""
    column = pa.ListArray.from_arrays(pa.array([0, n], pa.int32()), pa.array(np.zeros(n, np.int32)))
    pq.write_table(
        pa.table({"matched_rows": column}), path, compression="none", data_page_size=2**30, store_schema=False
    )


def _list_of_a_lying_file(path: Path) -> None:
    """The same, but the description says that there is one value."""
    n = 20_000_000
    _list(n, path)
    content = bytearray(path.read_bytes())
    told = _number(2 * n)
    at = content.index(told, len(content) - 8 - struct.unpack("<I", content[-8:-4])[0])
    content[at : at + len(told)] = b"\x82" + b"\x80" * (len(told) - 2) + b"\x00"
    path.write_bytes(content)
    assert pq.ParquetFile(path).metadata.row_group(0).column(0).num_values == 1


def _number(value: int) -> bytes:
    """A number of Thrift's compact protocol, without a sign."""
    parts = []
    while value >= 0x80:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def _long_text(path: Path) -> None:
    """65,536 times the same 20 MB: a kilobyte."""
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(65536, np.int32)), pa.array(["x" * 20_000_000]))
    options = {"compression": "zstd", "store_schema": False, "dictionary_pagesize_limit": 2**30}
    pq.write_table(pa.table({"status": texts}), path, **options)


def _beginnings(path: Path) -> None:
    """Texts that each begin as the one before."""
    texts = pa.array(["x" * 20_000] * 20_000)
    options = {"use_dictionary": False, "column_encoding": {"status": "DELTA_BYTE_ARRAY"}, "compression": "zstd"}
    pq.write_table(pa.table({"status": texts}), path, data_page_size=2**30, **options)


def _nothing(path: Path) -> None:
    with pq.ParquetWriter(path, pa.schema([("a", pa.null())]), compression="zstd") as writer:
        for _ in range(5):
            writer.write_table(pa.table({"a": pa.nulls(50_000_000)}), row_group_size=50_000_000)


def _wide(path: Path) -> None:
    pq.write_table(pa.schema([(f"c{i}", pa.int32()) for i in range(5000)]).empty_table(), path, store_schema=False)


def _described(path: Path, depth: int) -> None:
    """No rows of a column in so many groups, in one another. Arrow overflows the stack at some ten thousand."""
    group = b"\x35\x00\x18\x01a\x15\x02\x00"
    column = b"\x15\x02\x25\x00\x18\x01a\x00"
    columns = b"\x19\xfc" + _number(depth + 2) + b"\x48\x01r\x15\x02\x00" + group * depth + column
    description = b"\x15\x02" + columns + b"\x16\x00\x19\x0c\x00"
    path.write_bytes(b"PAR1" + description + struct.pack("<I", len(description)) + b"PAR1")


BOMBS = {
    "a giant list": (lambda path: _list(40_000_000, path), "would unfold"),
    "a giant list of a lying file": (_list_of_a_lying_file, "would unfold"),
    "a long text": (_long_text, "would unfold"),
    "texts that begin as the one before": (_beginnings, "would unfold"),
    "nothing": (_nothing, "would unfold"),
    "many columns": (_wide, "columns"),
    "deep columns": (lambda path: _described(path, 900), "nested too deeply"),
    "very deep columns": (lambda path: _described(path, 100_000), "columns"),
    "a long description": (lambda path: _described(path, 500_000), "its description has"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_before_they_unfold(name: str, tmp_path: Path) -> None:
    make, says = BOMBS[name]
    path = tmp_path / "a.parquet"
    make(path)
    before = pa.total_allocated_bytes()
    start = time.process_time()
    with pytest.raises(ValueError, match=says):
        read_parquet(path)
    assert time.process_time() - start < 5 and pa.total_allocated_bytes() - before < 2**24
    assert not has_matches(path) or name == "a giant list"


def test_what_pandas_writes_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 30_000
    table = pd.DataFrame({"method": rng.choice(["set", "bins"], n), "x": rng.normal(size=n), "n": np.arange(n)})
    table["task"] = table["method"].astype("category")
    table["good"] = table["x"] > 0
    table["none"] = None
    table["rows"] = [np.arange(i % 7, dtype=np.int32) for i in range(n)]
    for version in ("1.0", "2.0"):
        for options in ({}, {"compression": None, "row_group_size": 4000}, {"use_dictionary": False}):
            table.to_parquet(tmp_path / "a.parquet", data_page_version=version, **options)
            read = read_parquet(tmp_path / "a.parquet")
            pd.testing.assert_frame_equal(read, pd.read_parquet(tmp_path / "a.parquet"))


def test_headers_tell_of_each_page_what_arrow_wrote(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    n = 100_000
    pq.write_table(pa.table({"a": np.arange(n), "b": [f"{i % 50}" for i in range(n)]}), path, data_page_size=2**12)
    group = pq.ParquetFile(path).metadata.row_group(0)
    (described,) = parquet_files._description(path)[4]
    with path.open("rb") as file:
        for number in range(2):
            pages = parquet_files._pages(file.fileno(), path.stat().st_size, described[1][number], 10**6)
            assert sum(page.n_values for page in pages if not page.is_dictionary) == n
            assert len(pages) > 5 and sum(page.is_dictionary for page in pages) == 1
            told = group.column(number).total_uncompressed_size  # with the headers
            assert 0.8 * told < sum(page.n_bytes for page in pages) < told


def test_damaged_descriptions_and_pages_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"a": np.arange(1000), "b": ["x"] * 1000}), path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(400):
        content = bytearray(whole)
        for _ in range(3):
            content[rng.integers(len(content))] = rng.integers(256)
        path.write_bytes(content[: rng.integers(len(content))] if rng.random() < 0.2 else content)
        try:
            read_parquet(path)
        except ValueError:
            refused += 1
    assert refused > 100
