"""Reads Parquet files with limits on what their columns expand to in memory.

The sizes of columns are read from the file's description, in Thrift's compact protocol
(https://github.com/apache/parquet-format, parquet.thrift; https://github.com/apache/thrift, doc/specs): PyArrow ends the
process when it is asked for the metadata of a damaged column.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wheretolook.utils.files import check_file, max_expanded_bytes

MAX_FOOTER_BYTES = 2_000_000  # about 10,000 columns of row groups
MAX_LIST_LENGTH = 2000  # of lists in the footer, such as columns; Arrow overflows the stack at 10,000 nested columns
ROWS_PER_BATCH = 1 << 16


@contextmanager
def open_parquet(path: Path, **options: Any) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file with options of `pyarrow.parquet.ParquetFile`.

    Raises ValueError if it is none, its description is too large, or Arrow raises an error in the block.
    """
    _read_sizes(path)
    try:
        with pq.ParquetFile(path, thrift_container_size_limit=MAX_LIST_LENGTH, **options) as file:
            yield file
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error


def read_columns(file: pq.ParquetFile, path: Path, names: Sequence[str]) -> pa.Table:
    """Read columns of an open file in batches of rows.

    Raises ValueError if they expand to far more than the file has bytes, or rows are missing. A batch of texts has so
    few rows that it stays below the limit even if each value is as long as all stored values together.
    """
    limit = max_expanded_bytes(path.stat().st_size)
    expanded = 0
    longest = 1
    columns = [file.schema.column(number) for number in range(len(file.schema))]
    for group in _read_sizes(path):
        for column, (n_values, n_bytes) in zip(columns, group, strict=True):
            if column.path.partition(".")[0] not in names:
                continue
            expanded += max(n_bytes, 4 * n_values)
            if column.physical_type == "BYTE_ARRAY":
                longest = max(longest, n_bytes)
    batches = []
    if expanded <= limit:
        expanded = 0
        for batch in file.iter_batches(max(1, min(ROWS_PER_BATCH, limit // longest)), columns=list(names)):
            batches.append(batch)
            expanded += batch.nbytes
            if expanded > limit:
                break
    if expanded > limit:
        raise ValueError(f"its {path.stat().st_size:,} bytes expand to more than {limit:,}")
    table = pa.Table.from_batches(batches, pa.schema([file.schema_arrow.field(name) for name in names]))
    if table.num_rows != file.metadata.num_rows:
        raise ValueError(f"it has {table.num_rows:,} of {file.metadata.num_rows:,} rows")
    return table


def read_parquet(path: Path) -> pd.DataFrame:
    """Read a Parquet file as a table. Raises ValueError if it is damaged or expands to far more than its size."""
    try:
        with open_parquet(path, page_checksum_verification=True) as file:
            table: pd.DataFrame = read_columns(file, path, file.schema_arrow.names).to_pandas()
            return table
    except ValueError as error:
        raise ValueError(f"not a readable Parquet file: {error}") from error


def _read_sizes(path: Path) -> list[list[tuple[int, int]]]:
    """Number of values and uncompressed bytes of the columns of each row group. Raises ValueError if damaged."""
    n_bytes = check_file(path).st_size
    with path.open("rb") as file:
        file.seek(max(0, n_bytes - 8))
        footer_bytes = int.from_bytes(file.read(4), "little")
        if footer_bytes > min(MAX_FOOTER_BYTES, n_bytes - 12):
            raise ValueError(f"its description has {footer_bytes:,} bytes")
        file.seek(n_bytes - 8 - footer_bytes)
        footer = file.read(footer_bytes)
    try:
        groups = _ThriftReader(footer).struct().get(4, [])
        sizes = [[(int(chunk[3][5]), int(chunk[3][6])) for chunk in group[1]] for group in groups]
    except (LookupError, TypeError, RecursionError) as error:
        raise ValueError("its description is damaged") from error
    if any(min(size) < 0 for group in sizes for size in group):
        raise ValueError("a column has a negative size")
    return sizes


class _ThriftReader:
    """Reads structures of Thrift's compact protocol. Raises LookupError where the bytes end."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.position = 0

    def struct(self) -> dict[int, Any]:
        """Read the fields of a structure by number; texts and floating-point numbers are skipped."""
        fields = dict[int, Any]()
        number = 0
        while (head := self._byte()) & 0x0F:
            number = number + (head >> 4) if head >> 4 else self._zigzag()
            if number in fields:
                raise ValueError("its description has a field twice")
            fields[number] = head & 0x0F == 1 if head & 0x0F in (1, 2) else self._value(head & 0x0F)
        return fields

    def _value(self, kind: int) -> Any:
        if kind in (4, 5, 6):
            return self._zigzag()
        if kind == 12:
            return self.struct()
        if kind in (9, 10):
            head = self._byte()
            length = self._varint() if head >> 4 == 15 else head >> 4
            return [self._value(head & 0x0F) for _ in range(length)]
        if kind in (1, 2, 3, 7, 8):  # booleans in lists and bytes, doubles, texts
            n_bytes = self._varint() if kind == 8 else 8 if kind == 7 else 1
            self.position += n_bytes
            return None
        raise LookupError

    def _byte(self) -> int:
        self.position += 1
        return self.content[self.position - 1]

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise LookupError

    def _zigzag(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
