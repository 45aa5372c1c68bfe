"""Reads and writes the table of viewpoints: one Parquet file a scene.

A compact table holds the same rows in a third of the space; `read_table` reads both. The landmarks that each view
matched can be stored too, see `MATCH_FIELDS`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from wheretolook.dataset.viewpoint_table import APPEARANCE, CAMERA_ID, CHANGES, FIRST, LABELS, PIXELS, poses
from wheretolook.geometry.pose_files import POSE_COLUMNS, QUATERNION_COLUMNS, TRANSLATION_COLUMNS
from wheretolook.geometry.poses import Float, camera_centers, rotation_from_quaternion
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import atomic_write, open_parquet

CENTER_COLUMNS = ("x_m", "y_m", "z_m")

SCHEMA = pa.schema(
    [
        ("viewpoint_id", pa.int64()),
        ("location_id", pa.int32()),
        ("direction_id", pa.int32()),
        *((name, pa.float64()) for name in POSE_COLUMNS),
        ("n_visible", pa.int32()),
        ("visibility_rank", pa.int32()),
        ("status", pa.string()),
        ("error_m", pa.float32()),
        ("error_deg", pa.float32()),
        ("n_inliers", pa.int32()),
    ]
)
"""Columns of `viewpoints.parquet`. The pose is cam_from_world (quaternion wxyz, translation in metres), rank 0 is the
direction that sees most landmarks at its location. Until a viewpoint is labelled its status is "unlabelled"; afterwards
it is "localized", "too_few_matches" or "no_pose". Errors are those of the pose that RANSAC found, even if it has too
few inliers to be accepted ("no_pose"); NaN if there is none."""

COMPACT_SCHEMA = pa.schema(
    [
        field.with_name(CENTER_COLUMNS[TRANSLATION_COLUMNS.index(field.name)])
        if field.name in TRANSLATION_COLUMNS
        else field
        for field in SCHEMA
    ]
)
"""Columns of a compact table: in place of the translation, which differs in every row, the camera's centre in the world
(metres), which the viewpoints of a location share. The translation follows: t = -R c."""

MATCH_FIELDS = pa.schema([("matched_rows", pa.list_(pa.int32())), ("inlier_rows", pa.list_(pa.int32()))])
"""Two optional ragged columns: the landmarks matched in each view, and the inliers among them, as ascending rows of the
scene's `landmarks.npz`. A view without matches has two empty lists. Compact tables leave them out."""

PIXEL_FIELD = pa.schema([(PIXELS, pa.list_(pa.float32()))])
"""An optional ragged column of a table with `MATCH_FIELDS`: x and y, alternating, of the pixels of `matched_rows`, in
their order. With it several views of a location can be localized together (`looks/`)."""

FIRST_FIELDS = pa.schema([SCHEMA.field(name).with_name(f"{FIRST}{name}") for name in LABELS])
"""Optional columns of a table labelled by several hypotheses: status, errors and inliers of the first RANSAC result,
exactly as `LocalizerConfig.method` "first" labels."""

OPTIONAL_FIELDS = pa.schema(
    [(CAMERA_ID, pa.int32()), *FIRST_FIELDS, (APPEARANCE, pa.float32()), (CHANGES, pa.float32())]
)
"""Optional columns, which compact tables keep, too: the camera's number in `cameras.txt` where viewpoints have several;
`FIRST_FIELDS`; the strengths at which each view's image (`label.appearance`), or its scene (`label.changes`), was
changed."""


def write_table(table: pd.DataFrame, path: Path, compact: bool = False) -> None:
    """Write a table atomically as zstd Parquet with checksums; the same rows give the same bytes.

    Columns are those of `SCHEMA`, and of `OPTIONAL_FIELDS`, `MATCH_FIELDS` and `PIXEL_FIELD` if they are there. A
    compact table has `COMPACT_SCHEMA`, about 18 bytes a row; read back, its poses agree to 1e-12 and all else exactly.
    """
    if compact:
        table = table.assign(**dict(zip(CENTER_COLUMNS, _shared_centers(table).T, strict=True)))
    optional = [*OPTIONAL_FIELDS, *(() if compact else (*MATCH_FIELDS, *PIXEL_FIELD))]
    extra = [field for field in optional if field.name in table]
    schema = pa.schema([*(COMPACT_SCHEMA if compact else SCHEMA), *extra])
    content = pa.Table.from_pandas(table, schema=schema, preserve_index=False)
    content = content.replace_schema_metadata(None)  # it describes the data frame, not the rows
    options: dict[str, Any] = {}
    if compact:
        encodings = {"viewpoint_id": "DELTA_BINARY_PACKED"}
        encodings |= dict.fromkeys(("error_m", "error_deg"), "BYTE_STREAM_SPLIT")
        repeated = [name for name in COMPACT_SCHEMA.names if name not in encodings]  # few values
        options = {"compression_level": 19, "use_dictionary": repeated, "column_encoding": encodings}
    with atomic_write(path) as partial:
        pq.write_table(content, partial, compression="zstd", write_page_checksum=True, **options)


def _shared_centers(table: pd.DataFrame) -> Float:
    """Camera centres (B, 3) in metres, exactly equal for all viewpoints of a location."""
    centers = camera_centers(poses(table))
    _, first, rows = np.unique(table["location_id"], return_index=True, return_inverse=True)
    shared = centers[first][rows]
    apart = np.abs(shared - centers) > 0.5e-12  # a location with several centres keeps them
    return np.round(np.where(apart, centers, shared), 12) + 0.0  # no negative zero


def has_matches(path: Path, pixels: bool = False) -> bool:
    """Whether a table holds `MATCH_FIELDS`, with `pixels` also `PIXEL_FIELD`; a file that cannot be read does not."""
    try:
        with open_parquet(path) as file:
            return {*MATCH_FIELDS.names, *(PIXEL_FIELD.names if pixels else [])} <= {*file.schema_arrow.names}
    except ValueError:
        return False


def read_table(path: Path, matches: bool = False, pixels: bool = False) -> pd.DataFrame:
    """Read the columns of `SCHEMA`, and of `OPTIONAL_FIELDS` if present, of a table, compact or not.

    With `matches` also those of `MATCH_FIELDS`: in each row two int32 arrays, (M,) of the landmarks matched and (I,) of
    the inliers among them; with `pixels` also `PIXEL_FIELD`, (2 M,) float32. Raises TableError if the file is missing,
    truncated, no Parquet file, or lacks columns that were asked for.
    """
    if not path.is_file():
        raise TableError("there is no table of viewpoints", path=path, fix="Run the sample stage first.")
    requested = [*(MATCH_FIELDS if matches or pixels else ()), *(PIXEL_FIELD if pixels else ())]
    fix = "Run the stage that writes it again."
    try:
        with open_parquet(path, page_checksum_verification=True) as file:
            stored = {*file.schema_arrow.names}
            compact = not stored.isdisjoint(CENTER_COLUMNS)
            extra = [field for field in OPTIONAL_FIELDS if field.name in stored] + requested
            schema = pa.schema([*(COMPACT_SCHEMA if compact else SCHEMA), *extra])
            if missing := [name for name in schema.names if name not in stored]:
                if requested:
                    fix = f"Label again with `--label.store_{'pixels' if pixels else 'matches'} true`; "
                    fix += "compact tables never hold them."
                raise TableError("columns are missing", path=path, value=missing, fix=fix)
            content = file.read(schema.names).cast(schema)
            # NaN is stored as null, and means that a number is unknown; ids, counts and texts are known
            lacking = [f.name for f in schema if not pa.types.is_floating(f.type) and content[f.name].null_count]
            if lacking:
                raise ValueError(f"values are missing in {', '.join(lacking)}")
            frame: pd.DataFrame = content.to_pandas()
            if not frame["viewpoint_id"].is_unique:
                raise ValueError("a viewpoint_id is there twice")
    except ValueError as error:
        raise TableError(f"not a readable table of viewpoints: {error}", path=path, fix=fix) from error
    length = np.linalg.norm(frame[[*QUATERNION_COLUMNS]], axis=1)
    position = frame[[*(CENTER_COLUMNS if compact else TRANSLATION_COLUMNS)]].to_numpy()
    bad = ~(np.abs(length - 1) < 1e-6) | ~np.isfinite(position).all(1)
    if bad.any():
        raise TableError("a pose is no rigid transform", path=path, value=f"row {np.argmax(bad)}", fix=fix)
    if compact:
        rotation = rotation_from_quaternion(frame[[*QUATERNION_COLUMNS]])
        translation = -(rotation @ position[..., None])[..., 0]
        frame = frame.assign(**dict(zip(TRANSLATION_COLUMNS, translation.T, strict=True)))
    return frame[[*SCHEMA.names, *(field.name for field in extra)]]
