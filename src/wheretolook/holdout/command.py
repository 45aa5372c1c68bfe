"""`wheretolook check`: does the scorer tell good views from bad ones on this map? Its own photographs tell."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.dataset.names import LOCK, check_scene_name
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.locks import hold
from wheretolook.utils.options import CommandParser

if TYPE_CHECKING:
    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.holdout.photo_map import PhotographedMap
    from wheretolook.visibility.occlusion import OcclusionModel

ABOUT = """\
How well the scorer tells good views from bad ones on your own map, measured with the map's own photographs.

Blocks of neighbouring photographs are left out of the map, and localized against what remains. The model's poses are
the truth, so no mesh and no labels are needed."""

USAGE = "wheretolook check (--map SPARSE [--database FILE | --images FOLDER] | --scene NAME) [options]"

_NOTES = """\
FEATURES
  Photographs are localized with the keypoints that the map was made from, of SIFT, ALIKED, DISK, XFeat or SuperPoint: a
  COLMAP database, or hloc's features in HDF5. A database.db beside the model is found by itself. With --images instead,
  keypoints are extracted anew (SIFT, or by --extractor), and the landmarks triangulated anew at the model's poses.

METRES
  A photograph counts as localized within 5 cm and 0.4 degrees. Where metres are not known, it is 1 % of the median
  depth of what the photograph shows instead of 5 cm, and the map is scored as if its median depth were 5 m. A map of
  this project says whether it is in metres; of another --metres says so. A map whose cameras lie on their side is
  turned upright first, unless it has a mesh.

RESULTS (--out)
  check.csv    one row for each photograph, blocks.csv for each block, views.csv for each photograph of each block
  check.json   all numbers with 95 % intervals over blocks; check.png shows them
  work         finished blocks: an interrupted check goes on, and other weights are checked quickly

EXAMPLES
  wheretolook check --map sparse/0 --database database.db
  wheretolook check --map sparse/0 --images photographs --metres
  wheretolook check --scene photographs --weights my/weights/set.safetensors"""


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    made = CommandParser(prog="wheretolook check", usage=USAGE, description=ABOUT, epilog=_NOTES)
    add = made.add_argument
    add("--map", type=Path, metavar="SPARSE", help="folder of a COLMAP model, of any cameras")
    add("--scene", metavar="NAME", help="instead: a scene of a dataset, as `wheretolook map` made it")
    add("--database", type=Path, metavar="FILE", help="features: COLMAP's database.db, or hloc's feats-*.h5")
    add("--images", type=Path, metavar="FOLDER", help="instead: photographs, to extract them anew")
    add("--extractor", metavar="NAME", help="of --images: opencv, colmap, aliked, disk or xfeat (opencv)")
    add("--extractor-weights", metavar="FILE", default="", help="of a learned extractor; see docs/features.md")
    add("--metres", action="store_true", help="the map is in metres")
    add("--out", type=Path, metavar="FOLDER", help="where results go (data/checks/<name>)")
    add("--data", type=Path, default=Path("data"), metavar="FOLDER", help="folder of the datasets (data)")
    add("--name", default="", metavar="NAME", help="dataset of --scene, if several have such a scene")
    score = made.add_argument_group("what is checked")
    add = score.add_argument
    add("--weights", type=Path, metavar="FILE", help="weights, or a folder of them (those that ship)")
    add("--method", default="", metavar="NAME", help="`wheretolook evaluate --list-methods` (that of the weights)")
    add("--anywhere", action="store_true", help="let weights that are adapted to another place score here, too")
    add("--also", nargs="+", default=[], metavar="NAME", help="further methods, by the weights that ship")
    add("--mesh", type=Path, metavar="FILE", help="a mesh of the scene in the map's frame, in metres, for occlusion")
    add("--occlusion", metavar="NAME", help="mesh, hidden-points (from the landmarks alone) or none")
    how = made.add_argument_group("how")
    add = how.add_argument
    add("--views", type=int, default=60, metavar="N", help="photographs of a block that are localized, at most (60)")
    add("--workers", type=int, default=0, metavar="N", help="processes; 0 for one on each core (0)")
    add("--device", default="auto", metavar="NAME", help="auto, cpu, cuda, cuda:1 (auto)")
    return made


def run(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code 0; raises a WhereToLookError for bad input."""
    options = parser().parse_args(arguments)
    start = time.monotonic()
    _refuse(options)
    from wheretolook.figures.style import save_figure
    from wheretolook.holdout import photo_map as sources
    from wheretolook.holdout.checking import check_map
    from wheretolook.holdout.figure import check_figure
    from wheretolook.holdout.scores import Scoring
    from wheretolook.training.weights import read_training
    from wheretolook.utils.devices import usable_device

    device = usable_device(options.device)
    workers = options.workers or len(os.sched_getaffinity(0))
    scoring = Scoring(options.method, options.weights, tuple(options.also), options.anywhere)
    scoring.check()  # now, not after the work
    out = options.out or sources.folder_of_check(options.data, _name(options))
    scene = None if options.scene is None else sources.find_scene(options.data, options.scene, options.name)
    try:
        with _reading(scene), hold(out / ".lock", "check"):
            source, occlusion = _open(options, scene, out, device, workers)
            report = check_map(source, out / sources.WORK, scoring, occlusion, options.views, workers, device)
            report.save(out)
            save_figure(check_figure(report), out / "check.png")
    finally:
        with suppress(OSError):  # made for the lock of a check that then found nothing to work on
            out.rmdir()
    print("\n".join(report.lines()))
    if scoring.chosen is not None and read_training(scoring.chosen).get("photographs"):
        print(
            "the weights are adapted to a place and may have learnt from these photographs: then all this flatters "
            "them; `wheretolook adapt` has told what they are worth on blocks that they have not learnt from"
        )
    print(f"done in {time.monotonic() - start:.0f} s: {out}")
    return 0


def _refuse(options: argparse.Namespace) -> None:
    """Raise ConfigError for options that do not go together, before anything is read."""
    if (options.map is None) == (options.scene is None):
        raise ConfigError("what is checked is given by --map or by --scene", fix="Give one of them.")
    if options.database is not None and options.images is not None:
        fix = "Leave --images out to use the features that the map was made from, --database to extract them anew."
        raise ConfigError("features come from a database or from images", value=str(options.images), fix=fix)
    if options.views < 1 or options.workers < 0:
        fix = "Give --views of at least 1, --workers of at least 0."
        raise ConfigError("not such numbers", value=(options.views, options.workers), fix=fix)
    if options.scene is not None:
        check_scene_name(options.data, options.scene, options.name)
    from wheretolook.mapping.colmap_model import model_suffix
    from wheretolook.scorers.registry import check_method
    from wheretolook.select.weights import check_there

    if options.extractor is not None or options.extractor_weights:
        from wheretolook.features.config import ExtractorConfig

        ExtractorConfig(options.extractor or "opencv", weights=options.extractor_weights)  # refuses what there is not
        if options.images is None:
            fix = "Give --images, the folder of the photographs, or leave --extractor out."
            raise ConfigError("nothing is extracted where features are given", value=options.extractor, fix=fix)
    for name in (*([options.method] if options.method else []), *options.also):
        check_method(name)
    check_there(options.weights)
    if options.map is not None and options.mesh is None:  # a mesh is refused first, if the map has no metres
        model_suffix(options.map)


def _name(options: argparse.Namespace) -> str:
    """What the folder of results is called: as the scene, behind its dataset's name if that is given."""
    from wheretolook.mapping.config import ExistingModelConfig

    if options.scene is None:
        return ExistingModelConfig(model=options.map).scene_name
    return "-".join(filter(None, (options.name, options.scene)))


def _reading(scene: SceneFolder | None) -> AbstractContextManager[None]:
    """Meanwhile no stage changes the dataset of a scene."""
    return nullcontext() if scene is None else hold(scene.folder.parent / LOCK, "check", shared=True)


def _open(
    options: argparse.Namespace, scene: SceneFolder | None, out: Path, device: str, workers: int
) -> tuple[PhotographedMap, OcclusionModel]:
    """The map, of a scene if one was named, and what hides its landmarks; results go to a folder."""
    from wheretolook.dataset.environment import ColmapEnvironment, ColmapFiles
    from wheretolook.features.config import ExtractorConfig
    from wheretolook.holdout import photo_map as source
    from wheretolook.mapping.config import ExistingModelConfig
    from wheretolook.mapping.sources import features_beside, photographs_of

    mesh = options.mesh
    metric = options.metres
    name = options.scene
    if scene is not None:
        model = scene.map
        metric = metric or not scene.is_photographed or source.says_metric(model)
        if mesh is None and scene.mesh.is_file():
            mesh = scene.mesh
    else:
        model = options.map
        name = ExistingModelConfig(model=model).scene_name
        metric = metric or source.says_metric(model)
    if mesh is not None and not metric:
        fix = "Say --metres if it is, or leave --mesh out."
        raise ConfigError("a mesh is of use only for a map in metres", value=str(mesh), fix=fix)
    environment = ColmapEnvironment(ColmapFiles(model, mesh=mesh), occlusion=options.occlusion or "", device=device)
    occlusion = environment.occlusion
    given = options.images or options.database or features_beside(model) or photographs_of(model)
    if given is None and scene is not None and scene.mesh.is_file():  # its images were rendered, and are gone
        problem = "neither the features nor the photographs of this map are known"
        fix = "Map the scene again with `wheretolook map --map.keep_database true`, which keeps the features."
        raise MapError(problem, path=model, fix=fix)
    extractor = ExtractorConfig(options.extractor or "opencv", weights=options.extractor_weights)
    where = (out / source.WORK, workers, device, extractor)
    model, features = source.features_of(model, options.images, options.database, *where)
    return source.open_map(model, features, metric, name, keep_frame=mesh is not None), occlusion
