"""`wheretolook check`: how well the scorer separates good from bad views of your own map."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.commands.options import LabelOptions, ScorerOptions
from wheretolook.dataset.config import LOCK, checked_accuracy
from wheretolook.dataset.layout import find_scene
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.mapping.colmap_model import holds_model, model_suffix
from wheretolook.mapping.config import FrameOptions, place_name
from wheretolook.mapping.map import find_features, find_photographs
from wheretolook.scorers.registry import check_method
from wheretolook.training.weights import read_training
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import MapError, check_range, reject
from wheretolook.utils.files import safe_child
from wheretolook.utils.processes import cores, hold

if TYPE_CHECKING:
    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.holdout.holdout import HoldoutResult
    from wheretolook.holdout.photo_map import PhotographedMap
    from wheretolook.visibility.occlusion import OcclusionModel


CHECKS = "checks"  # folder of the folders of checks, next to the datasets
WORK = "work"  # folder of cached work, in that of a check


def folder_of_check(data: Path, name: str) -> Path:
    """Return the folder of a check's results, by its name; ConfigError if it would be outside the folder of checks."""
    return safe_child(safe_child(data, CHECKS, "the folder of all checks"), name, "the name of a check")


def knows_photographs(files: SceneFolder, images: Path | None = None, database: Path | None = None) -> bool:
    """Return whether the photographs that a scene's map was made from, or their features, are known."""
    return holds_model(files.map) and any((images, database, find_features(files.map), find_photographs(files.map)))


def check_name(options: LabelOptions, files: SceneFolder) -> str:
    """Return the folder name of a scene's check: that of `check --name`, unless only that of `check` exists."""
    names = f"{options.name}-{files.name}", files.name
    return next((name for name in names if (options.data / CHECKS / name).is_dir()), names[0])


def hold_out_photographs(
    options: LabelOptions,
    stage: str,
    model: Path,
    name: str,
    frame: FrameOptions = FrameOptions(),
    images: Path | None = None,
    database: Path | None = None,
) -> tuple[PhotographedMap, list[HoldoutResult]]:
    """Return a map and its photographs, held out in blocks; finished blocks are shared with `wheretolook check`.

    The folder of the photographs and the database are given if they are not next to the map. See
    `wheretolook.holdout.photo_map.open_map` for the other arguments and errors.
    """
    from wheretolook.holdout.holdout import hold_out_blocks
    from wheretolook.holdout.photo_map import features_of, open_map

    out = folder_of_check(options.data, name)
    workers = options.n_workers
    device = options.warp_device
    with hold(out / ".lock", stage):
        folder, features = features_of(model, images, database, out / WORK, workers, device)
        source = open_map(folder, features, name, frame, model)
        return source, hold_out_blocks(source, out / WORK, workers=workers, device=device)


@dataclass(frozen=True, kw_only=True)
class Check(ScorerOptions, FrameOptions):
    """Check how well scores separate good from bad views of your own map, by its own photographs.

    Blocks of neighbouring photographs are held out of the map, and localized against what remains. The model's poses
    are the ground truth, so no mesh and no labels are needed.

    Features: photographs are localized with the keypoints that the map was made from, of SIFT, ALIKED, DISK, XFeat or
    SuperPoint: a COLMAP database, or hloc's features in HDF5. By default those in the model's folder or above are used. With
    --images instead, keypoints are extracted again (SIFT, or by --extractor), and the landmarks triangulated again at
    the model's poses.

    Metres: a photograph counts as localized within 5 cm and 0.4 degrees, or --accuracy. Where metres are not known, it
    is 1 % of the median depth of the photograph instead of 5 cm, and the map is scored as if its median depth were 5 m.
    A map of this project knows whether it is in metres; for another, give --scale (1 for metres), --distance or --positions. A map
    whose cameras are clearly not level is turned upright first, unless --up states what is up.

    Results (--out):
      check.csv    one row for each photograph, blocks.csv for each block, views.csv for each photograph of each block
      check.json   all numbers with 95 % intervals over blocks; check.png shows them
      work         finished blocks: an interrupted check continues, and other weights are checked quickly

    Examples:
      wheretolook check --map sparse/0 --database database.db
      wheretolook check --map sparse/0 --images photographs --scale 1
      wheretolook check --scene photographs --weights my/weights/set.safetensors

    Args:
        map: folder of a COLMAP model, of any cameras.
        scene: instead, a scene of a dataset, as `wheretolook map` made it.
        data: folder of the datasets.
        name: dataset of the scene, if several have such a scene.
        database: features: COLMAP's database.db, or hloc's feats-*.h5.
        images: instead, photographs, to extract features again.
        extractor: extractor for the images, as --mapping.extractor.method of `wheretolook map`.
        extractor_weights: weights of a learned extractor; see docs/features.md.
        out: folder of the results; by default data/checks/<name>.
        also: further methods to check, with the bundled weights.
        fov: horizontal field of view in degrees of narrower views, three of which are simulated from the keypoints of each
            photograph: where all photographs localize, some of these do not.
        views: largest number of photographs of a block that are localized.
        workers: worker processes; 0 for one on each core.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """

    map: Path | None = None
    scene: str | None = None
    data: Path = Path("data")
    name: str = ""
    database: Path | None = None
    images: Path | None = None
    extractor: str | None = None
    extractor_weights: str = ""
    out: Path | None = None
    also: tuple[str, ...] = ()
    fov: float | None = None
    views: int = 60
    workers: int = 0
    device: str = "auto"

    def __post_init__(self) -> None:
        check_range("views", self.views, 1)
        check_range("workers", self.workers, 0)
        if self.fov is not None:
            check_range("fov", self.fov, 1, 179)
        extracting = self.extractor is not None or bool(self.extractor_weights)
        reject(
            ((self.map is None) == (self.scene is None), "what is checked is given by either --map or --scene", None),
            (bool(self.database and self.images), "features come from either --database or --images", None),
            (extracting and self.images is None, "an extractor needs --images, the photographs", self.extractor),
        )
        self._extractor()
        self.frame_options()
        if self.accuracy is not None:
            checked_accuracy(self.accuracy)

    def _extractor(self) -> ExtractorConfig:
        return ExtractorConfig(self.extractor or "opencv", weights=self.extractor_weights)

    def run(self) -> None:
        """Check the map, write the report to `out`, and print a summary."""
        start = time.monotonic()
        for method in filter(None, (self.method, *self.also)):
            check_method(method)
        scene = None if self.scene is None else find_scene(self.data, self.scene, self.name)
        name = "-".join(filter(None, (self.name, self.scene))) if self.map is None else place_name(self.map)
        if self.map is not None:
            model_suffix(self.map)
        # the imports above are light, those below take seconds
        from wheretolook.figures.floor_plan import save_figure
        from wheretolook.holdout.report import check_figure, check_map
        from wheretolook.holdout.scores import Scoring

        device = usable_device(self.device)
        workers = self.workers or cores()
        scoring = Scoring(self.method, self.weights, self.also, self.anywhere, self.accuracy)
        scoring.check()
        out = self.out or folder_of_check(self.data, name)
        with ExitStack() as locks:
            if scene is not None:  # no command may change it meanwhile; others may be mapped
                locks.enter_context(hold(scene.folder / LOCK, "check", shared=True))
            locks.enter_context(hold(out / ".lock", "check"))
            photographs, occlusion = self._open(scene, out / WORK, device, workers)
            report = check_map(photographs, out / WORK, scoring, occlusion, self.views, workers, device)
            report.save(out)
            save_figure(check_figure(report), out / "check.png")
        print("\n".join(report.lines()))
        if scoring.chosen is not None and read_training(scoring.chosen).get("photographs"):
            print(
                "warning: the weights are adapted to one scene and may have been trained on these photographs; "
                "`wheretolook adapt` reports their measures on blocks that they were not trained on"
            )
        print(f"done in {time.monotonic() - start:.0f} s: {out}")

    def _open(
        self, scene: SceneFolder | None, work: Path, device: str, workers: int
    ) -> tuple[PhotographedMap, OcclusionModel]:
        """Open the map with its photographs' features, and the occlusion model; results go to `work`."""
        from wheretolook.holdout.photo_map import features_of, open_map

        mesh = self.mesh
        model = self.map if scene is None else scene.map
        assert model is not None
        frame = self.frame_options()
        rendered = scene is not None and scene.mesh.is_file()
        if mesh is None and scene is not None and rendered:
            mesh = scene.mesh
        if rendered and not any((self.images, self.database, find_features(model), find_photographs(model))):
            problem = "neither the features nor the photographs of this map are known"
            fix = "Map the scene again with `wheretolook map --mapping.keep_database true`, which keeps the features."
            raise MapError(problem, path=model, fix=fix)
        folder, features = features_of(model, self.images, self.database, work, workers, device, self._extractor())
        name = self.scene or place_name(model)
        photographs = replace(open_map(folder, features, name, frame, model), fov_deg=self.fov)
        files = ColmapFiles(model, mesh=mesh, mesh_up=self.mesh_up, frame=frame)
        camera_id = next(iter(photographs.model.cameras))  # occlusion depends on none
        opened = Scene.of_colmap(files, camera_id, self.occlusion, device=device)
        return photographs, opened.occlusion
