"""Options of the commands that score views of a COLMAP model: `select` and `score`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.commands.options import CameraOptions, OcclusionOptions, ScorerOptions
from wheretolook.dataset.config import checked_accuracy
from wheretolook.figures import KINDS
from wheretolook.mapping.config import FrameOptions
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.validation import check_choice

if TYPE_CHECKING:
    from wheretolook.geometry.camera import Camera
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.where_to_look import WhereToLook


@dataclass(frozen=True, kw_only=True)
class SelectorOptions(CameraOptions, OcclusionOptions, ScorerOptions, FrameOptions):
    """A COLMAP model, and how its views are scored.

    Args:
        map: folder of a COLMAP model, binary or text.
        out: file of the views; its ending decides the format.
        format: csv, json, tum, colmap or benchmark.
        floor_plan: also draw the views on a plan of the landmarks: a file .png, .pdf or .svg.
        fov: instead of a camera, horizontal field of view of a pinhole in degrees.
        size: image size of that pinhole in pixels, such as 640x480.
        depth: folder of depth images, named like the map's images.
        depth_scale: units of integer depth images in a metre.
        database: COLMAP's database.db or hloc's feats-*.h5, whose descriptors show which landmarks look alike; by default
            hloc's near the model, or a database near it of other features than SIFT.
        max_error: leave out landmarks with a larger mean reprojection error, in pixels.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """

    map: Path
    out: Path
    format: str | None = None
    floor_plan: Path | None = None
    fov: float | None = None
    size: str | None = None
    depth: Path | None = None
    depth_scale: float = 1000.0
    database: Path | None = None
    max_error: float | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        self.frame_options()
        if self.accuracy is not None:
            checked_accuracy(self.accuracy)
        self.named_camera()
        if self.floor_plan is not None:
            check_choice("format of figures", self.floor_plan.suffix[1:].lower(), KINDS)

    def named_camera(self) -> Camera | int | None:
        """Return the camera asked for: one, a camera_id of the map, or None for the map's own."""
        from wheretolook.geometry.camera import PinholeCamera, parse_size

        described = super().named_camera()
        if self.fov is None:
            if self.size is not None:
                raise ConfigError("an image size belongs to a field of view, --fov", value=self.size)
            return described
        if described is not None:
            raise ConfigError("the camera is described in several ways", value=self.fov, fix="Give one of them.")
        return PinholeCamera.of_field_of_view(self.fov, *parse_size(self.size or "640x480"))

    def open_map(self, **directions: Any) -> WhereToLook:
        """Open the map; `directions` are options of `WhereToLook.from_colmap`."""
        from wheretolook.mapping.colmap_model import model_suffix
        from wheretolook.utils.devices import usable_device
        from wheretolook.utils.warp import start_warp
        from wheretolook.visibility.counting import compile_kernels

        model_suffix(self.map)
        device = usable_device(self.device)
        with ThreadPoolExecutor(1) as executor:  # kernels compile, if they must, during imports and reading
            compiled = executor.submit(compile_kernels, start_warp(device))
            from wheretolook.select.where_to_look import WhereToLook

            selector = WhereToLook.from_colmap(
                self.map,
                weights=self.weights,
                method=self.method,
                camera=self.named_camera(),
                mesh=self.mesh,
                depth=self.depth,
                depth_scale=self.depth_scale,
                occlusion=self.occlusion,
                database=self.database,
                max_reprojection_error_px=self.max_error,
                device=device,
                anywhere=self.anywhere,
                **vars(self.frame_options()),
                **directions,
            )
            compiled.result()
        return selector if self.accuracy is None else selector.at_accuracy(self.accuracy)


def finish(command: SelectorOptions, selector: WhereToLook, views: SelectedViews, given: int, locations: str) -> None:
    """Write views and the floor plan, and print a summary; `locations` names the kind of what was `given`."""
    views.save(command.out, command.format)
    if command.floor_plan is not None:
        from wheretolook.figures.style import save_figure

        save_figure(selector.floor_plan(views), command.floor_plan)
        print(f"floor plan: {command.floor_plan}")
    from wheretolook.geometry.camera import describe_camera

    localization_map = selector.localization_map
    print(f"{selector.frame.describe()}; camera: {describe_camera(localization_map.camera)}")
    n_used = len({*views.waypoint.tolist()})
    skipped = f", {given - n_used} left out" if n_used < given else ""
    features = localization_map.landmarks.features or "no descriptors"
    landmarks = f"{len(localization_map.landmarks):,} landmarks ({features})"
    print(f"{landmarks}, occlusion: {localization_map.occlusion.name}, method: {views.method}")
    best = views.rank == 1
    kind, scores = ("best scores", views.score) if views.set_score is None else ("set scores", views.set_score)
    print(f"{locations}: {n_used}{skipped}; {kind} {scores[best].min():.3g} to {scores[best].max():.3g}")
    counts = {
        "no visible landmark": views.n_visible[best] == 0,
        "outside the training distribution (column in_range)": ~views.in_range[best],
    }
    for what, rows in counts.items():
        if rows.any():
            print(f"best views, {what}: {rows.sum()} of {len(rows)}")
