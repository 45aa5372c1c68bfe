"""The sub-commands that there are, and what the command line tells of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Stage:
    """What the command line knows of a stage."""

    function: str  # in `wheretolook.stages`
    text: str  # what it does
    matter: str  # options that `--help` shows, with blanks between; one without a dot may be short
    groups: tuple[str, ...] = ()  # `--help-all` shows the options in these groups; none for all
    example: str = "--config configs/demo.yaml"  # arguments to try
    short: Mapping[str, str] = field(default_factory=dict)  # flags that may be given without their group
    config: str = ""  # name of the file in configs/ that is read unless --config names one
    notes: str = ""  # what else to know
    refuses: str = ""  # module whose `check` of an experiment refuses what can be refused before long imports


_SPACE = ("occlusion", "scenes.free_space", "scenes.mapped_space", "map.photographs.assume_metric")

STAGES = {
    "scenes": Stage(
        "make_scenes",
        "Make or load the textured meshes, or fuse one from colour and depth images: --rgbd.",
        "scenes.train scenes.val scenes.test scenes.seed scenes.meshes scenes.apartment.n_rooms "
        "scenes.apartment.area_m2 scenes.apartment.texture_richness scenes.apartment.clutter scenes.apartment.vary "
        "rgbd up",
        ("scenes",),
        "--config configs/demo.yaml --scenes.train 5\n  wheretolook scenes --name kitchen --rgbd FOLDER",
        {"--rgbd": "--scenes.rgbd.folder", "--up": "--scenes.rgbd.up"},
    ),
    "map": Stage(
        "make_maps",
        "Build a COLMAP map of every scene by renders, or of photographs: --images. Or take one of your own: --model.",
        "model mesh database images map.existing.name map.n_images map.extractor.method "
        "map.photographs.name map.photographs.scale.positions label.workers",
        ("map", "scenes.free_space", "label.workers"),
        "--name photos --images FOLDER",
        {f"--{name}": f"--map.existing.{name}" for name in ("model", "mesh", "database")},
        notes="""\
A model of your own, from COLMAP or hloc, in metres with z up, becomes a scene for sample, viewpoint-map and plan:
  wheretolook map --name mymap --model sparse/0 --mesh scan.glb --database database.db
Mesh and database may be left out. With --images its landmarks are triangulated anew. Not upright, or not in metres?
--map.existing.level true, --map.photographs.scale.positions FILE. Its own camera looks, unless --camera names one.""",
    ),
    "sample": Stage(
        "sample",
        "Choose viewpoints by the landmarks they see.",
        "sample.grid sample.directions sample.lattice sample.keep sample.min_visible sample.max_locations "
        "sample.max_directions sample.seed occlusion.model scenes.free_space.clearance_m",
        ("sample", *_SPACE),
        "--config configs/demo.yaml --sample.max_locations 100",
    ),
    "label": Stage(
        "label",
        "Render and localize every viewpoint, measure the pose error. Resumes.",
        "engine label.ray_address label.workers label.shard_size label.store_matches label.store_pixels "
        "label.localizer.max_ratio label.localizer.lightglue label.localizer.max_error_px label.localizer.min_inliers "
        "tracking.folder",
        ("label", "tracking"),
        "--config configs/paper.yaml --engine ray",
    ),
    "train": Stage(
        "train",
        "Learn from the labels, one weights file for each method.",
        "train.methods train.also train.val_fraction train.seed train.accelerator train.devices train.mlp.epochs "
        "train.mlp.batch_size train.mlp.balance train.set.epochs tracking.folder",
        ("train", "tracking"),
        "--config configs/demo.yaml --train.methods '[mlp-2d+z, set]'",
    ),
    "evaluate": Stage(
        "evaluate",
        "Score all methods on the test scenes.",
        "evaluate.methods evaluate.weights evaluate.split evaluate.top_n evaluate.thresholds evaluate.occlusions "
        "evaluate.candidates evaluate.photographs evaluate.reference evaluate.seed tracking.folder",
        ("evaluate", "occlusion", "tracking"),
        "--config configs/demo.yaml --evaluate.methods '[random, visible, set]'",
        notes="What evaluate.methods may name: wheretolook evaluate --list-methods",
    ),
    "adapt": Stage(
        "adapt",
        "Adapt the weights that ship to one place, by views localized there; kept only if that makes them better.",
        "scene map images database weights out minutes adapt.seed label.workers tracking.folder",
        ("adapt", *_SPACE, "label", "tracking"),
        "--map sparse/0 --database database.db\n  "
        "wheretolook adapt --config configs/demo.yaml --scene apartment-000 --minutes 5",
        {
            f"--{name}": f"--adapt.{name}"
            for name in ("scene", "map", "images", "database", "weights", "out", "minutes")
        },
        notes="""\
Learns from the map's own photographs, left out in blocks as `wheretolook check` does, of a COLMAP model (--map) or of a
scene made of photographs; and from a scene's labels, or, where it has a mesh and none, from as many of its viewpoints
as can be labelled in the minutes; done again, it goes on with more. The weights are for this place alone:
  wheretolook select --map sparse/0 --weights data/checks/mymap/adapted.safetensors --at 1,2,1.4 --out views.csv""",
    ),
    "viewpoint-map": Stage(
        "viewpoint_map",
        "Score every direction at every free voxel of a scene, for planners to look up. Needs no labels.",
        "scene method weights out viewpoint_map.grid viewpoint_map.directions viewpoint_map.lattice occlusion.model",
        ("viewpoint_map", *_SPACE),
        """--config configs/demo.yaml --scene apartment-000 \\
      --weights data/release/weights/mlp-2d+z.safetensors --out apartment.map""",
        {f"--{name}": f"--viewpoint_map.{name}" for name in ("scene", "method", "weights", "out")},
        notes="""\
Reads a scene's map and its mesh, as the scenes and map stages leave them; a scene of photographs has no mesh, and is
free where scenes.mapped_space says. Without weights or a method, the best weights of the dataset, or else those that
ship, score the views. The folder holds plain arrays and LAYOUT.txt, which says how to read them; in Python:

  from wheretolook import ViewpointMap
  viewpoint_map = ViewpointMap.load("apartment.map", mmap=True)
  choice = viewpoint_map.best((1.0, 2.0, 1.5))    # None where no camera can be, else axis, score, n_visible""",
    ),
    "plan": Stage(
        "plan",
        "Plan a path on which the camera sees what it needs to know where it is; a table, a picture and a film of it.",
        "scene start goal method weights out film stops plan.stops.least_score plan.against plan.rerun "
        "plan.planner.time_s plan.planner.score_weight occlusion.model",
        ("plan", *_SPACE, "tracking"),
        """--config configs/demo.yaml --scene apartment-000 --start '[-4, -3, 1.4]' --goal '[4, 3, 1.4]' \\
      --plan.against '[forward]' --film mp4 --out way""",
        {f"--{name}": f"--plan.{name}" for name in ("scene", "start", "goal", "method", "weights", "out", "film")}
        | {"--stops": "--plan.stops.looks"},
        notes="""\
Reads a scene's map and its mesh, if it has one, as the scenes and map stages leave them.
To plan in what depth images saw as free, without the mesh: --occlusion.model tsdf""",
    ),
    "compare-paths": Stage(
        "compare_paths",
        "Plan paths between random places by several methods, render what the camera sees, localize it. Resumes.",
        "paths.scenes paths.pairs paths.methods paths.weights paths.seed paths.min_distance_m paths.stops.looks "
        "paths.stops.least_score paths.last_views paths.planner.time_s paths.planner.score_weight occlusion.model "
        "label.workers tracking.folder",
        ("paths", "occlusion", "scenes.free_space", "label", "tracking"),
        "--config configs/demo.yaml --paths.methods '[forward, set]' --paths.pairs 5",
    ),
    "release": Stage(
        "release",
        "Make a compact copy, data/release; given that copy and weights trained on it, evaluate and write its card.",
        "release_name evaluate.methods evaluate.occlusions evaluate.candidates tracking.folder",
        ("evaluate", "occlusion", "tracking"),
        "--config configs/release.yaml",
        refuses="wheretolook_paper.release.naming",
    ),
    "log-release": Stage(
        "log_release",
        "Log what a release ships as MLflow runs, as if it had been made here; once.",
        "tracking.folder tracking.experiment",
        ("tracking",),
        "--tracking.folder elsewhere",
        config="release",
        notes="""\
A release ships its tables, not an MLflow store. This logs them into one, in seconds: an evaluation with its nested
runs, a train run for each weights record, the comparison of learners, planned paths and measured times. Done again, it
adds only what is new; `make ui` does it first. Without --config it is configs/release.yaml.""",
    ),
    "figures": Stage(
        "figures",
        "Draw every figure and table of the paper, and others, from logged runs.",
        "out only kinds tracking.folder",
        ("figures", "tracking"),
        "--only '[top_n, runtimes]' --kinds '[svg]'",
        {f"--{name}": f"--figures.{name}" for name in ("out", "only", "kinds")},
        config="release",
        notes="""\
`wheretolook figures --list` tells what there is, of the paper and beyond. Each file says which runs it was drawn from,
and is attached to them as an artifact under figures/. Where a run is missing, the command that makes it is named and
the others are drawn; if one of the paper's, or one of those named with --only, is missing, the exit code is 2.
Without --config it is configs/release.yaml, whose runs are logged first. Tables are CSV, Markdown and TeX.""",
    ),
    "demo": Stage(
        "",
        "Run all stages on the embedded default and draw the score figure.",
        "scenes.train scenes.test scenes.meshes map.n_images sample.max_locations sample.max_directions label.workers "
        "train.methods train.mlp.epochs evaluate.methods evaluate.weights tracking.folder",
        example="--name small --scenes.train 2",
        config="demo",
        notes="Without --config it is configs/demo.yaml.",
    ),
}
"""The sub-commands, in the order of the line of stages."""

OWN = {
    "select": ("wheretolook.select.command", "The best views at places of your own COLMAP model; needs no dataset."),
    "check": ("wheretolook.holdout.command", "How well views of your own map are told apart, by its own photographs."),
    "view": ("wheretolook.view.command", "A scene or your own map in the browser, with the score of every view."),
    "export": ("wheretolook.robot.command", "What a robot needs to score views of your own map, without PyTorch."),
    "benchmark": ("wheretolook_paper.benchmark.command", "The Active Localization Benchmark on its scene folders."),
}
"""Sub-commands with options of their own, which are no stages of an experiment: their module, and what they do."""

USAGE = """\
wheretolook: where to point a camera so that it knows where it is

usage: wheretolook STAGE [--config FILE.yaml] [--GROUP.SETTING VALUE ...] [--debug]

stages, in order; each reads what the one before it left in <data>/<name>/
{stages}

of your own map, without a dataset:
{own}

  wheretolook select --map sparse/0 --at waypoints.csv --out views.csv
  wheretolook check --map sparse/0 --database database.db
  wheretolook export --map sparse/0 --out FOLDER
  wheretolook STAGE --help         the options that matter to a stage, with their defaults
  wheretolook STAGE --help-all     every option it reads
  wheretolook demo                 is configs/demo.yaml unless --config names another
  wheretolook map --config configs/demo.yaml --map.n_images 120
  wheretolook scenes --name scan --rgbd FOLDER        a scene from colour and depth images with poses
  wheretolook map --name photos --images FOLDER       a scene known from photographs alone
  wheretolook map --name mymap --model sparse/0       a scene from a COLMAP model of your own
  wheretolook label --config configs/paper.yaml --engine ray     on a Ray cluster; the default is local
  wheretolook evaluate --list-methods    what can be compared
  wheretolook viewpoint-map --config configs/demo.yaml --scene apartment-000 --out room.map
  wheretolook figures --list             figures and tables of the paper; `wheretolook figures` draws them
  wheretolook --version
"""
