"""Open Parquet files by PyArrow, with its errors and the size that a file expands to as ValueError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wheretolook.utils.files import check_file, max_expanded_bytes


@contextmanager
def open_parquet(path: Path, **options: Any) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file with options of `pyarrow.parquet.ParquetFile`.

    Raises ValueError if it is none, expands to far more than its size, or Arrow raises an error in the block.
    """
    limit = max_expanded_bytes(check_file(path).st_size)
    limits = {"thrift_container_size_limit": 2000}  # Arrow overflows the stack at 10,000 nested columns
    try:
        with pq.ParquetFile(path, **limits, **options) as file:
            groups = range(file.num_row_groups)
            expanded = sum(file.metadata.row_group(number).total_byte_size for number in groups)
            if expanded > limit:
                raise ValueError(f"it expands to {expanded:,} bytes, more than {limit:,}")
            yield file
    except (pa.ArrowException, OSError, KeyError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error


def read_parquet(path: Path) -> pd.DataFrame:
    """Read a Parquet file as a table. Raises ValueError as `open_parquet`."""
    with open_parquet(path, page_checksum_verification=True) as file:
        table: pd.DataFrame = file.read().to_pandas()
        return table
