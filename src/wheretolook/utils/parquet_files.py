"""Reads Parquet files with limits on what their columns expand to in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wheretolook.utils.reading import check_file, max_expanded_bytes

MAX_FOOTER_BYTES = 2_000_000  # about 10,000 columns of row groups
MAX_LIST_LENGTH = 2000  # of lists in the footer, such as columns; Arrow overflows the stack at 10,000 nested columns
ROWS_PER_BATCH = 1 << 16


@contextmanager
def open_parquet(path: Path, **options: Any) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file with options of `pyarrow.parquet.ParquetFile`.

    Raises ValueError if it is none, its description is too large, or Arrow raises an error in the block.
    """
    n_bytes = check_file(path).st_size
    with path.open("rb") as file:
        file.seek(max(0, n_bytes - 8))
        footer_bytes = int.from_bytes(file.read(4), "little")
    if footer_bytes > min(MAX_FOOTER_BYTES, n_bytes):
        raise ValueError(f"its description has {footer_bytes:,} bytes")
    try:
        with pq.ParquetFile(path, thrift_container_size_limit=MAX_LIST_LENGTH, **options) as opened:
            yield opened
    except (pa.ArrowException, OSError, KeyError) as error:
        raise ValueError(str(error)) from error


def read_columns(file: pq.ParquetFile, path: Path, names: Sequence[str]) -> pa.Table:
    """Read columns of an opened file in batches of rows.

    Raises ValueError if they expand to far more than the file has bytes, or rows are missing. A batch of texts has so
    few rows that it stays below the limit even if each value is as long as all stored values together.
    """
    limit = max_expanded_bytes(path.stat().st_size)
    expanded = 0
    longest = 1
    for chunk in _chunks(file.metadata, names):
        expanded += max(chunk.total_uncompressed_size, 4 * chunk.num_values)
        if chunk.physical_type == "BYTE_ARRAY":
            longest = max(longest, chunk.total_uncompressed_size)
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


def _chunks(metadata: pq.FileMetaData, names: Sequence[str]) -> Iterator[pq.ColumnChunkMetaData]:
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(number)
            if chunk.path_in_schema.partition(".")[0] in names:
                yield chunk


def read_parquet(path: Path) -> pd.DataFrame:
    """Read a Parquet file as a table. Raises ValueError if it is damaged or expands to far more than its size."""
    try:
        with open_parquet(path, page_checksum_verification=True) as file:
            table: pd.DataFrame = read_columns(file, path, file.schema_arrow.names).to_pandas()
            return table
    except ValueError as error:
        raise ValueError(f"not a readable Parquet file: {error}") from error
