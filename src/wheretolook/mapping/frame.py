"""The frame of a map whose scale is not known: metres from markers, a distance or positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float
from wheretolook.mapping import scale as scales
from wheretolook.mapping.colmap_model import registered_names
from wheretolook.mapping.config import ScaleConfig
from wheretolook.mapping.markers import Marker, MarkerView, detect_markers, marker_detector, place_marker
from wheretolook.mapping.photographs import read_photograph
from wheretolook.mapping.scale import MapScale, Similarity
from wheretolook.utils.errors import ConfigError, MapError


@dataclass(frozen=True, eq=False)
class KnownScale:
    """The settings that give the scale, with the tables they name."""

    config: ScaleConfig
    sizes_m: Mapping[int, float] | float
    positions: Mapping[str, Float]

    @staticmethod
    def read(config: ScaleConfig) -> KnownScale:
        if config.has_marker_sizes or (config.distance is not None and config.distance.marker_ids):
            marker_detector(config.dictionary)  # raises if there is no such dictionary
        sizes = config.marker_size_m if config.marker_table is None else scales.read_marker_table(config.marker_table)
        return KnownScale(config, sizes, {} if config.positions is None else scales.read_positions(config.positions))


def find_scale(
    model: Any,
    known: KnownScale,
    upright: Similarity,
    photographs: Path | None = None,
    turned: bool = True,
    progress: bool = True,
) -> tuple[MapScale, Similarity]:
    """The scale of a `pycolmap.Reconstruction`, and the similarity from its frame to the world.

    `upright` is the latter but for the scale; positions overrule it. Markers are looked for in the folder of its
    photographs, read as `read_photograph` does. Raises MapError or ConfigError if the scale asked for cannot be found.
    """
    names = registered_names(model)
    config = known.config
    centers = {name: model.images[number].projection_center() for number, name in names.items()}
    if known.positions:
        return scales.scale_from_positions(centers, known.positions)
    scale = MapScale()
    if config.has_marker_sizes:
        views = _marker_views(model, photographs, config.dictionary, turned, progress)
        if not isinstance(known.sizes_m, float | int):
            views = {marker: seen for marker, seen in views.items() if marker in known.sizes_m}
        markers, unused = _place(views)
        scale = scales.scale_from_markers(markers, known.sizes_m, unused=unused)
    elif config.distance is not None:
        wanted = config.distance.marker_ids
        views = _marker_views(model, photographs, config.dictionary, turned, progress) if wanted else {}
        names_of_ends = config.distance.first, config.distance.second
        first, second = (_place_of(end, centers, views, photographs) for end in names_of_ends)
        scale = scales.scale_from_distance(first, second, config.distance.distance_m)
    return scale, replace(upright, scale=scale.factor, translation=scale.factor * upright.translation)


def _marker_views(
    model: Any, folder: Path | None, dictionary: str, turned: bool, progress: bool
) -> dict[int, list[MarkerView]]:
    """Views of markers in photographs with a pose, by marker. Found at full size, given in pixels of the map."""
    if folder is None:
        fix = "Give the folder of the model's images, --images, or a distance between photographs, or positions."
        raise ConfigError("markers are found in photographs, and none were given", value=dictionary, fix=fix)
    found: dict[int, list[MarkerView]] = {}
    for number, name in tqdm(registered_names(model).items(), "map: markers", disable=not progress, unit="image"):
        image = model.images[number]
        camera = model.cameras[image.camera_id]
        rgb = read_photograph(folder / name, turned)
        reduction = np.array([camera.width, camera.height]) / rgb.shape[1::-1]
        for marker, corners in detect_markers(rgb, dictionary, folder / name).items():
            view = MarkerView(name, camera, image.cam_from_world().matrix(), corners * reduction)
            found.setdefault(marker, []).append(view)
    return dict(sorted(found.items()))


def _place(views: Mapping[int, list[MarkerView]]) -> tuple[list[Marker], dict[str, str]]:
    """Markers placed, and why others could not be placed: a false detection in one photograph must not stop the map."""
    markers = []
    unused = {}
    for marker, seen in views.items():
        try:
            markers.append(place_marker(marker, seen))
        except MapError as error:
            unused[f"marker {marker}"] = f"{error.problem}: {error.value}"
    return markers, unused


def _place_of(
    end: str, centers: Mapping[str, Float], views: Mapping[int, list[MarkerView]], folder: Path | None
) -> Float:
    """Where an end of a known distance is, (3,) in COLMAP's frame."""
    if end.startswith("marker:"):
        number = int(end.removeprefix("marker:"))
        if number not in views:
            problem = f"no placed photograph sees marker {number}"
            raise MapError(problem, path=folder, value=end, fix="Name another.")
        return place_marker(number, views[number]).center
    if end not in centers:
        fix = "Name one that was placed, relative to its folder; markers are written marker:7."
        raise MapError("the map has no such photograph", path=folder, value=end, fix=fix)
    return centers[end]
