"""Parquet files, opened with limits: what their columns unfold to is known before anything is unfolded.

A row may hold a list of any length, a value be repeated without end, and a file's own counts may lie. What Arrow
unfolds follows from the headers of the pages alone, so these are read here, by the format's description:
https://github.com/apache/parquet-format (parquet.thrift), in Thrift's compact protocol.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wheretolook.utils.npz_files import FREE_BYTES, MAX_RATIO
from wheretolook.utils.reading import check_file

MAX_COLUMNS = 1000  # with the groups that they are in
MAX_DEPTH = 20  # of such groups; a list has three
MAX_DESCRIPTION_BYTES = 2_000_000  # of the whole file, at its end: some 10,000 columns of row groups
MAX_PAGES = 100_000  # of all columns; a page has 20,000 rows or a megabyte, unless a file has many small row groups
MAX_HEADER_BYTES = 2**16  # of a page; Arrow keeps no statistics of long values there

_AT_ONCE = 1 << 16  # rows that are read together
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8, "BYTE_ARRAY": 8}
_OF_DICTIONARY = (2, 8)  # encodings of values that are repeated, or begin as the one before
_OF_PREFIXES = 7
_DATA = 5  # fields of a page's header, by the kind of the page
_DICTIONARY = 7
_DATA_2 = 8
_DEPTH = 16  # of structures and lists in one another, of which a description has nine
_DAMAGED = "its description is damaged"
_KINDS = {_DATA: 2, _DICTIONARY: 2, _DATA_2: 4}  # and in these, the field of the encoding


@contextmanager
def open_parquet(path: Path, **options: Any) -> Iterator[pq.ParquetFile]:
    """A Parquet file. ValueError if it is none, or describes more than tables have, or for errors of Arrow meanwhile.

    `options` are those of `pyarrow.parquet.ParquetFile`.
    """
    try:
        _check_columns(_description(path))
        with pq.ParquetFile(path, **options) as opened:
            yield opened
    except (pa.ArrowException, OSError, KeyError) as error:
        raise ValueError(str(error)) from error


def read_columns(file: pq.ParquetFile, path: Path, names: Sequence[str]) -> pa.Table:
    """Columns of an opened file.

    ValueError if they would unfold to far more than the file has bytes, which is found out before anything is
    unfolded, or do not have as many rows as it says.
    """
    _check_unfolded(file, path, names)
    batches = list(file.iter_batches(_AT_ONCE, columns=list(names)))  # memory for no more rows than there are
    table = pa.Table.from_batches(batches, pa.schema([file.schema_arrow.field(name) for name in names]))
    told = {file.metadata.num_rows, sum(file.metadata.row_group(i).num_rows for i in range(file.num_row_groups))}
    if told != {table.num_rows}:
        raise ValueError(f"it says that it has {max(told):,} rows, and has {table.num_rows:,}")
    return table


def read_parquet(path: Path) -> pd.DataFrame:
    """Read a Parquet file as a table. Raises ValueError if it is damaged, or unfolds to far more than its size."""
    try:
        with open_parquet(path, page_checksum_verification=True) as file:
            table: pd.DataFrame = read_columns(file, path, file.schema_arrow.names).to_pandas()
            return table
    except ValueError as error:
        raise ValueError(f"not a readable Parquet file: {error}") from error


def _description(path: Path) -> dict[int, Any]:
    """What a file tells of itself at its end. ValueError if it is too long, or damaged."""
    n_bytes = check_file(path).st_size
    with path.open("rb") as file:
        file.seek(max(0, n_bytes - 8))
        length = int.from_bytes(file.read(4), "little")
        if length > n_bytes - 12:
            raise ValueError("it has no end of a Parquet file")
        if length > MAX_DESCRIPTION_BYTES:
            raise ValueError(f"its description has {length:,} bytes")
        file.seek(n_bytes - 8 - length)
        content = file.read(length)
    try:
        return _Compact(content).struct()
    except IndexError as error:
        raise ValueError("its description does not end") from error


def _check_columns(description: dict[int, Any]) -> None:
    """Raise ValueError if columns are too many, or nested too deeply: ten thousand deep, Arrow overflows the stack."""
    columns = description.get(2)
    if not isinstance(columns, list) or len(columns) > MAX_COLUMNS:
        raise ValueError(f"it has more than {MAX_COLUMNS:,} columns")
    open_groups = list[int]()  # how many members each still lacks
    for column in columns:
        while open_groups and open_groups[-1] == 0:
            open_groups.pop()
        if open_groups:
            open_groups[-1] -= 1
        members = column.get(5, 0) if isinstance(column, dict) else -1
        if not isinstance(members, int) or members < 0:
            raise ValueError(_DAMAGED)
        open_groups.append(members)
        if len(open_groups) > MAX_DEPTH:
            raise ValueError("its columns are nested too deeply")


def _check_unfolded(file: pq.ParquetFile, path: Path, names: Sequence[str]) -> None:
    """Raise ValueError if columns would unfold to far more than a file has bytes, or have too many pages."""
    n_bytes = path.stat().st_size
    unfolded = 0
    n_pages = 0
    columns = [file.schema.column(number) for number in range(len(file.schema))]
    wanted = [
        number
        for number, column in enumerate(columns)
        if any(column.path == name or column.path.startswith(f"{name}.") for name in names)
    ]
    if not wanted:
        raise ValueError("it has no columns")
    groups = _description(path).get(4, [])  # Arrow ends the process where one of these is damaged
    with path.open("rb") as stream:
        for group in groups:
            chunks = group.get(1) if isinstance(group, dict) else None
            if not isinstance(chunks, list) or len(chunks) != len(columns):
                raise ValueError(_DAMAGED)
            for number in wanted:
                pages = _pages(stream.fileno(), n_bytes, chunks[number], MAX_PAGES - n_pages)
                n_pages = n_pages + len(pages)
                unfolded = unfolded + _unfolded(columns[number], pages)
                if unfolded > max(FREE_BYTES, MAX_RATIO * n_bytes):
                    raise ValueError(f"its {n_bytes:,} bytes would unfold to more than {unfolded:,}")


@dataclass(frozen=True)
class _Page:
    """What the header of a page tells: how many bytes and values it has, and how these are encoded."""

    n_bytes: int
    n_values: int
    encoding: int
    is_dictionary: bool


def _unfolded(column: pq.ColumnSchema, pages: Sequence[_Page]) -> int:
    """Bytes that the pages of a column within a row group unfold to, at most."""
    width = column.length if column.physical_type == "FIXED_LEN_BYTE_ARRAY" else _WIDTHS[column.physical_type]
    width += 4 * (column.max_definition_level > 0)  # the levels that say which values are there
    found = sum(max(page.n_bytes, page.n_values * width) for page in pages)
    if column.physical_type == "BYTE_ARRAY":  # each value may be the longest
        longest = max((page.n_bytes for page in pages if page.is_dictionary), default=0)
        found += sum(page.n_values * longest for page in pages if page.encoding in _OF_DICTIONARY)
        found += sum(page.n_values * page.n_bytes for page in pages if page.encoding == _OF_PREFIXES)
    return found


def _pages(file: int, n_bytes: int, chunk: Any, at_most: int) -> list[_Page]:
    """The pages of a column within a row group. ValueError if there are too many, or a header is damaged."""
    told = chunk.get(3) if isinstance(chunk, dict) else None
    start, length, dictionary = (told.get(field) for field in (9, 7, 11)) if isinstance(told, dict) else [None] * 3
    if not isinstance(start, int) or not isinstance(length, int):
        raise ValueError(_DAMAGED)
    if isinstance(dictionary, int) and (0 < dictionary < start or start == 0 < dictionary):  # without rows, no data
        start = dictionary
    end = start + length
    found = list[_Page]()
    if not 0 <= start <= end <= n_bytes:
        raise ValueError(f"a column from byte {start:,} to {end:,} of {n_bytes:,}")
    while start < end:
        if len(found) >= at_most:
            raise ValueError(f"it has more than {MAX_PAGES:,} pages")
        header, length = _header(file, start, min(MAX_HEADER_BYTES, end - start))
        kind = next((kind for kind in _KINDS if kind in header), 0)
        about = header.get(kind)
        encoding = _KINDS.get(kind, 0)
        about = about if isinstance(about, dict) else {1: 0, encoding: 0}  # of an index, which has no values
        numbers = header.get(2), header.get(3), about.get(1), about.get(encoding)
        if not all(isinstance(number, int) and number >= 0 for number in numbers):
            raise ValueError("the header of a page is damaged")
        found.append(_Page(header[2], about[1], about[encoding], kind == _DICTIONARY))
        start += length + header[3]
    return found


def _header(file: int, at: int, most: int) -> tuple[dict[int, Any], int]:
    """A page's header, and how many bytes it has."""
    for n_bytes in (min(512, most), most):
        content = _Compact(os.pread(file, n_bytes, at))
        try:
            return content.struct(), content.at
        except IndexError:
            continue
    raise ValueError("the header of a page does not end")


class _Compact:
    """Thrift's compact protocol. IndexError where the bytes end; https://github.com/apache/thrift, doc/specs."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.at = 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """The fields of a structure by their numbers: integers, structures and lists; of others nothing is kept."""
        fields = dict[int, Any]()
        number = 0
        while (head := self._byte()) & 0x0F:
            number = number + (head >> 4) if head >> 4 else self._integer()
            if number in fields:  # Arrow might take the other one
                raise ValueError("a field is given twice")
            fields[number] = self._value(head & 0x0F, depth)
        return fields

    def _byte(self) -> int:
        self.at += 1
        return self.content[self.at - 1]

    def _length(self) -> int:
        value = shift = 0
        while shift < 70:
            byte = self._byte()
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value
        raise ValueError("a number is too long")

    def _integer(self) -> int:
        value = self._length()
        return (value >> 1) ^ -(value & 1)

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (1, 2):  # true and false
            return kind == 1
        if kind in (4, 5, 6):
            return self._integer()
        if depth < _DEPTH and kind == 12:
            return self.struct(depth + 1)
        if depth < _DEPTH and kind in (9, 10):
            head = self._byte()
            length = self._length() if head >> 4 == 15 else head >> 4
            return [self._element(head & 0x0F, depth + 1) for _ in range(length)]
        if kind not in (3, 7, 8):  # one byte, eight, and a text
            raise ValueError("a field of an unknown kind")
        skipped = {3: 1, 7: 8}.get(kind) or self._length()
        self.at += skipped
        return None

    def _element(self, kind: int, depth: int) -> Any:
        """An element of a list: as a field's value, but true and false take a byte."""
        return self._byte() == 1 if kind in (1, 2) else self._value(kind, depth)
