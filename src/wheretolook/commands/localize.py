"""`wheretolook localize`: poses of your own images in your own map."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.options import CameraOptions
from wheretolook.dataset.config import checked_accuracy
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.figures import KINDS
from wheretolook.geometry.camera import Camera
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.photographs import SUFFIXES, find_photograph_files
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, MapError, check_choice, reject

if TYPE_CHECKING:
    from wheretolook.select.image_localizer import ImageLocalizer
    from wheretolook.select.localized import Localized


@dataclass(frozen=True, kw_only=True)
class Localize(CameraOptions, FrameOptions):
    """Localize images in a COLMAP or hloc map; needs no dataset and no weights.

    Each image is localized alone, or with --turns all as one rig: views from one location, with known rotations. An
    equirectangular image (--panorama) is cut into a rig of six pinholes, and has the pose of its centre: x right, y down,
    z forward.

    Map: its descriptors are those of a COLMAP database or of hloc's features in HDF5, by default the ones in the model's
    folder or above it. Images are described by the extractor of these.
    Camera: by default, for a mapping image, the model's. Otherwise it is assumed: one of the model of
    the same proportions, or a pinhole of the EXIF focal length, whose focal length is refined with the pose, from 1/1.6 to
    1.6 of it; deviation and probability state what stays uncertain. The column camera_from names the camera, focal_px its
    focal length. A file of the cameras of images (--camera FILE) has lines such as hloc's queries_with_intrinsics.txt:
    name MODEL width height parameters. Images are reduced to the size of the map's.

    Rotations (--turns), a row for each image: its name in the column image, or the nearest time stamp for images that
    are named by their time, or in the order of the images:
      CSV          yaw, pitch, roll in degrees (to the left, upwards, clockwise); or qw, qx, qy, qz: camera-to-rig, of a
                   camera that looks along z, and perhaps x, y, z in metres
      TUM          odometry, "t x y z qx qy qz qw", of the camera, or of a robot (x forward, z up) with a camera along x

    Results (--out), in the map's own frame and unit; a row for each image:
      csv, json    x, y, z: camera centre; qw, qx, qy, qz: camera-to-world; json with all rivals
      images.txt   COLMAP's, world-to-camera, the localized images only
    probability is that of the pose to be within the accuracy; in a map of unknown unit, its median depth counts as 5 m.
    deviation is one standard deviation of the position. Rivals are other poses that matches support. An image that is
    not localized has the reason.

    Examples:
      wheretolook localize --map sparse/0 --images query.jpg --out pose.csv --figure pose.png
      wheretolook localize --map sparse/0 --images queries --out images.txt
      wheretolook localize --map sparse/0 --panorama street.jpg --out pose.csv
      wheretolook localize --map sparse/0 --images a.jpg b.jpg --turns turns.csv --scale 1 --out pose.json --next

    Args:
        map: folder of a COLMAP model.
        images: images, or folders of them; also without --images, before the other options.
        panorama: instead, equirectangular images of 360 x 180 degrees, twice as wide as high, or folders of them.
        turns: rotations of the images, which are then localized together.
        out: file of the poses: .csv, .json or images.txt.
        figure: also draw matches, pose and rivals: a file .png, .pdf or .svg; for several images a folder.
        prior: rough x,y,z of the camera in the map, and perhaps its yaw in degrees: one more hypothesis.
        accuracy: limits of the errors in metres and degrees that the probability refers to.
        next: also print where a camera that turns in place should look next, by the bundled weights.
        pitch_deg: lowest and highest pitch in degrees of the next view.
        pan_deg: its lowest and highest pan in degrees, to the left from the first view; by default any.
        database: COLMAP's database.db or hloc's feats-*.h5.
        extractor: extractor for the images, as --mapping.extractor.method of `wheretolook map`.
        extractor_weights: weights of a learned extractor; see docs/features.md.
        pairs: hloc's file of the mapping images that retrieval found for each image, in lines "image mapping_image".
            Images are matched with the landmarks of these alone.
        lightglue: weights of LightGlue for learned features, or kornia for its copy. Images are then matched with the five
            mapping images that observe most of the landmarks that they matched.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """

    POSITIONAL: ClassVar = "images"
    SHORT: ClassVar = {"pitch": "pitch_deg", "pan": "pan_deg"}

    map: Path
    images: tuple[Path, ...] = ()
    panorama: tuple[Path, ...] = ()
    turns: Path | None = None
    out: Path | None = None
    figure: Path | None = None
    prior: tuple[float, ...] | None = None
    accuracy: tuple[float, float] = (0.05, 0.4)
    next: bool = False
    pitch_deg: tuple[float, float] = (-45.0, 45.0)
    pan_deg: tuple[float, float] | None = None
    database: Path | None = None
    extractor: str | None = None
    extractor_weights: str = ""
    pairs: Path | None = None
    lightglue: str = ""
    device: str = "auto"

    def __post_init__(self) -> None:
        self.frame_options()
        self._query_camera()
        others = self.panorama and (self.turns, self.camera, self.camera_id, self.next) != (None, None, None, False)
        problem = "a panorama shows all directions: leave --turns, --camera, --camera-id and --next out"
        reject(
            (bool(self.images) == bool(self.panorama), "images are given by either --images or --panorama", None),
            (bool(others), problem, self.panorama),
        )
        checked_accuracy(self.accuracy)
        if self.figure is not None and self.figure.suffix:
            check_choice("format of figures", self.figure.suffix[1:].lower(), KINDS)
        if self.extractor_weights and self.extractor is None:
            raise ConfigError("extractor_weights need an extractor", value=self.extractor_weights)
        _ = self._extractor

    @property
    def _extractor(self) -> ExtractorConfig | None:
        return None if self.extractor is None else ExtractorConfig(self.extractor, weights=self.extractor_weights)

    def _query_camera(self) -> Camera | int | str | Path | None:
        """Return the camera of all images, its camera_id, the file of the cameras of images, or "panorama"."""
        if self.panorama:
            return "panorama"
        if self.camera is not None and self.camera_id is None and os.path.isfile(self.camera):
            return Path(self.camera)
        return self.named_camera()

    def run(self) -> list[Localized]:
        """Localize the images, write `out` and `figure`, and print a summary."""
        from wheretolook.select.localized import check_localized_format, save_localized
        from wheretolook.select.query_images import distinct_names

        start = time.monotonic()
        if self.out is not None:
            check_localized_format(self.out)
        paths = self._paths()
        several = len(paths) > 1 and self.turns is None
        if several and self.figure is not None and self.figure.suffix:
            raise ConfigError("several images need a folder of figures", path=self.figure, fix="Name a folder.")
        if several and self.next:
            raise ConfigError("the next view is that of one rig", value=len(paths), fix="Give --turns, or one image.")
        names = distinct_names(paths)
        if self.figure is not None:
            replaced = {self._figure_of(name).resolve() for name in names} & {path.resolve() for path in paths}
            if replaced:
                raise ConfigError("a figure would replace an image", path=replaced.pop(), fix="Name another folder.")
        from wheretolook.select.image_localizer import ImageLocalizer

        device = usable_device(self.device)
        localizer = ImageLocalizer.open(
            self.map, self.database, self.frame_options(), self._extractor, device, self.pairs, self.lightglue
        )
        landmarks = localizer.landmarks
        print(f"{localizer.frame.describe()}; {len(landmarks):,} landmarks ({landmarks.features})")
        results = []
        try:
            for result in self._results(localizer, paths, names):
                if self.figure is not None and result.images:
                    self._draw(result, localizer)
                results.append(result.without_images())
        finally:  # an interruption keeps those that are finished
            if self.out is not None and results:
                save_localized(results, self.out)
        self._summarize(results)
        if self.next:
            self._print_next(result, device)
        where = "" if self.out is None else f": {self.out}"
        print(f"{len(paths)} images in {time.monotonic() - start:.1f} s{where}")
        return results

    def _paths(self) -> list[Path]:
        """Return the files of all images. Raises MapError if one is missing, or a folder has none."""
        paths: list[Path] = []
        for path in self.images or self.panorama:
            found = [path] if path.is_file() else find_photograph_files(path)
            if not found:
                fix = f"Give images, or folders of images that end in {', '.join(SUFFIXES)}."
                raise MapError("there is no image here", path=path, fix=fix)
            paths += found
        return paths

    def _results(self, localizer: ImageLocalizer, paths: list[Path], names: list[str]) -> Iterable[Localized]:
        """Return the result of the rig, or those of each image as they are ready."""
        camera = localizer.images.known_camera(self._query_camera())
        if self.turns is not None or len(paths) == 1:
            return [localizer.localize(paths, self.turns, camera, self.prior, self.accuracy)]
        return localizer.localize_each(paths, names, camera, self.prior, self.accuracy)

    def _draw(self, result: Localized, localizer: ImageLocalizer) -> None:
        from wheretolook.figures.floor_plan import save_figure
        from wheretolook.select.localized import figure_of

        save_figure(figure_of(result, localizer.landmarks.points), self._figure_of(result.names[0]))

    def _figure_of(self, name: str) -> Path:
        """Return the file of the figure of an image, or of the rig whose first image it is."""
        assert self.figure is not None
        return self.figure if self.figure.suffix else (self.figure / name).with_suffix(".png")

    def _print_next(self, result: Localized, device: str) -> None:
        """Print where the camera should look next."""
        from wheretolook.select.where_to_look import WhereToLook

        frame = vars(self.frame_options())
        camera = result.cameras[0]
        look = WhereToLook.from_colmap(self.map, camera=camera, database=self.database, device=device, **frame)
        chosen = look.next_look(result, self.pitch_deg, self.pan_deg)
        side = "left" if chosen.pan_deg > 0 else "right"
        turn = f"turn {abs(chosen.pan_deg):.0f} degrees to the {side}, to a pitch of {chosen.pitch_deg:.0f} degrees"
        print(f"next view: {turn}; it localizes with an expected probability of {chosen.gain:.2f}")

    def _summarize(self, results: list[Localized]) -> None:
        """Print each result if they are few, and how many are localized."""
        if len(results) <= 10:
            for result in results:
                print(f"{', '.join(result.names)}: {result.describe()}")
        found = [result for result in results if result.status == "localized"]
        sure = sum(result.probability >= 0.95 for result in found)
        print(f"localized: {len(found)} of {len(results)}, {sure} with a probability of at least 95 %")
