"""Regenerate all results of the shipped weights: tables, the card, numbers of the pages, figures and notebooks. Resumes.

    python -m wheretolook_paper.studies.results --meshes MESHES --photographs PHOTOGRAPHS
    python -m wheretolook_paper.studies.results --meshes MESHES --only '[interiors, cameras]'

`MESHES` holds the interiors by other authors that `data/release/results/generalization.md` names (GLB), `PHOTOGRAPHS` the
folders kitchen, fox and lund_door (docs/results.md). Neither is part of the project: without them, steps that need them
are left out. `data/release/results/made.json` records for each step its commands, the device, and the weights and tables
that it is computed from; a step whose record agrees is not repeated. Labels and maps of interrupted steps are reused.

`variants.csv` is made with the weights, by `wheretolook train` and `wheretolook release`, the adapted rows of
`photographs.csv` by `wheretolook adapt`: neither is a result of the shipped weights.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from jsonargparse import auto_cli

from wheretolook.dataset.config import ALL
from wheretolook.evaluation.config import SCORES_CSV
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import copy_file, read_json_object, sha256, write_json, write_text
from wheretolook.utils.package import VERSION
from wheretolook_paper.evaluation.comparison import replace_rows
from wheretolook_paper.evaluation.extend import EXTEND_CSV, PHOTOGRAPHS_CSV
from wheretolook_paper.evaluation.looks import LOOKS_CSV
from wheretolook_paper.paths.path_report import PATHS_CSV, pooled_paths
from wheretolook_paper.release.card import GENERALIZATION_CSV, GENERALIZATION_MD
from wheretolook_paper.release.numbers import Numbers, pages, updated
from wheretolook_paper.release.runs import RUNTIMES_CSV

RELEASE = Path("data/release")
RESULTS = RELEASE / "results"
MADE = RESULTS / "made.json"
SET, MATCHABILITY, NETWORK = (
    RELEASE / "weights" / f"{name}.safetensors" for name in ("set", "matchability", "mlp-2d+z")
)
CAMERAS = {f"test-{angle}": ("--camera.fov_deg", str(angle)) for angle in (45, 60, 75, 90, 110)} | {
    "fisheye": ("--camera.model", "OPENCV_FISHEYE", "--camera.params", "[244.46, 244.46, 320, 240, 0, 0, 0, 0]")
}
"""Options of the cameras of the views; the last is equidistant, 150 degrees across."""

SCENES = ("aws_house", "nexuiz_aggressor", "nexuiz_aggressor_b", "nexuiz_desertfactory", "nexuiz_dieselpower",
          "nexuiz_dieselpower_b")  # fmt: skip

Words = Sequence[str]


@dataclass(frozen=True)
class Step:
    """A part of the results.

    Attributes:
        commands: arguments of `python -m`, or of `python` for a script, run one after the other.
        inputs: weights, and tables of other steps, that the commands read.
        collect: writes the release's tables from what the commands wrote.
        needs: folder that the user must give: "meshes", "photographs" or none.
    """

    commands: Sequence[Words]
    inputs: Sequence[Path] = ()
    collect: Callable[[], None] = lambda: None
    needs: str = ""

    def record(self) -> dict[str, object]:
        """Return what decides the step's results."""
        inputs = {path.name: sha256(path)[:16] for path in self.inputs if path.is_file()}
        return {"inputs": inputs, "commands": [" ".join(words) for words in self.commands]}


def steps(
    meshes: Path = Path("MESHES"), photographs: Path = Path("PHOTOGRAPHS"), device: str = "DEVICE"
) -> dict[str, Step]:
    """Return all steps by name, in an order in which each finds the tables of those before it."""
    scenes = ", ".join(f"{{path: {meshes / name}.glb, split: test}}" for name in SCENES)
    others = ("--scenes.meshes", f"[{scenes}]")

    def run(command: str, name: str, *options: str, config: str = "others") -> Words:
        named = ("--name", name) if name else ()
        return ("wheretolook", command, "--config", f"configs/{config}.yaml", *named, *options, "--device", device)

    def mapped(name: str, *options: str) -> list[Words]:
        return [run("scenes", name, *options, *others), run("map", name, *options, "--mapping.camera", "{fov_deg: 90}")]

    def labelled(name: str, *options: str, sample: Words = (), label: Words = ()) -> list[Words]:
        return [*mapped(name, *options), run("sample", name, *options, *sample), run("label", name, *options, *label)]

    def study(name: str, *options: str) -> Words:
        return (f"wheretolook_paper.studies.{name}", *options)

    # rows of the table are resumed, which other weights would not make
    extensions = f"data/extend-{sha256(SET)[:8] if SET.is_file() else ''}"

    def extended(scene: str, seed: int) -> Words:
        # fusing the depth images of a game level takes minutes
        more = () if scene.startswith("nexuiz") else ("pairs-landmarks", "pairs-depth")
        policies = ", ".join(("none", "random", "even", "worst", "walk", "pairs", *more))
        return study(
            "extend", "--mesh", f"data/test-90/{scene}/mesh.glb", "--seed", str(seed), "--policies", f"[{policies}]",
            "--work", extensions, "--out", f"{extensions}/{EXTEND_CSV}"
        )  # fmt: skip

    def checked(name: str, kind: str, folder: str, *options: str) -> Words:
        return study("photographs", kind, str(photographs / folder), "--work", f"data/photographs/{name}", *options)

    def planned(name: str, images: str, *frame: str) -> Words:
        work = f"data/photographs/{name}"
        shown = ("--images", str(photographs / images), "--device", device)
        out = ("--out", str(RESULTS / "plan_photographs.csv"))
        return study(
            "plan_photographs", "--map", f"{work}/map", "--work", f"{work}/check", "--name", name, *frame, *shown, *out
        )

    bundled = f"[{SET}, {MATCHABILITY}, {NETWORK}]"
    few = ("--sample.max_locations", "60", "--sample.max_directions", "14")
    views = [
        words
        for name, camera in CAMERAS.items()
        for words in labelled(name, *camera, sample=few if name == "fisheye" else ())
    ]
    tested = ("--datasets", f"[{', '.join(f'data/{name}' for name in CAMERAS)}]", "--split", "test")
    many = ("--sample.max_locations", "30", "--sample.max_directions", "50")
    looks = labelled("looks", sample=many, label=("--label.store_pixels", "true"))
    tabled = ("--out", str(RESULTS / "photographs.csv"))
    metric = ("--frame.scale", "1", "--frame.up", "0.0089,-0.9044,-0.4265")
    benchmark = "tests/benchmarks/bench_"
    measured = [f"data/runtimes/{name}.json" for name in ("visibility", "step")]
    film = ("--scenes.test", "1")
    compared = ("--paths.methods", "[forward, set]", "--paths.pairs", "8")
    # the pair: a path on which looking ahead fails on a part
    shown = ("--scene", "apartment-210", "--path", "data/film/results/paths/apartment-210", "--pair", "1")
    return {
        "interiors": Step(
            [run("demo", "interiors", *others, "--scenes.test", "0", "--evaluate.weights", bundled)],
            (SET, MATCHABILITY, NETWORK),
            _generalization,
            "meshes",
        ),
        "cameras": Step(
            [*views, study("cameras", *tested, "--out", str(RESULTS / "cameras.csv"))],
            (SET, MATCHABILITY),
            needs="meshes",
        ),
        "looks": Step(
            [*looks, run("evaluate", "looks", "--evaluate.weights", f"[{SET}]", "--evaluate.methods", "[set, visible]")],
            (SET,),
            _looks,
            "meshes",
        ),
        "relocalize": Step(
            [*looks[:3], run("relocalize", "looks")], (SET,), lambda: _copy("looks/results/relocalize.csv"), "meshes"
        ),
        **{
            f"paths-{scene}": Step(
                [*mapped("test-90"), run("compare-paths", "test-90", "--in-scenes", f"[{scene}]")],
                (SET,),
                _paths,
                "meshes",
            )
            for scene in ("apartment-210", "apartment-211", *SCENES)
        },
        "extend": Step(
            [
                run("scenes", "test-90", *CAMERAS["test-90"], *others),
                *(extended(scene, seed) for scene in ("apartment-210", "apartment-211", *SCENES) for seed in range(3)),
                (*extended("apartment-210", 0), "--policies", "[oracle]", "--trials", "6"),
            ],
            (SET,),
            lambda: _copy(f"{extensions}/{EXTEND_CSV}".removeprefix("data/")),
            "meshes",
        ),
        "extend-photographs": Step(
            [study("extend_photographs", "--map", f"data/photographs/{name}/map", "--name", name, "--features",
                   f"data/photographs/{name}/photographs/database.db", "--work", extensions, "--images", images,
                   "--n", n, "--out", str(RESULTS / PHOTOGRAPHS_CSV))
             for name, images, n in (("kitchen", "30", "10"), ("fox", "8", "4"))],
            (SET,),
            needs="photographs",
        ),
        **{
            f"nav2-{scene}": Step(
                [
                    *mapped("test-90"),
                    study("nav2", "--dataset", "data/test-90", "--scene", scene, "--pairs", pairs,
                          "--out", str(RESULTS / "nav2.csv"), "--device", device),
                ],
                (SET,),
                needs="meshes",
            )
            for scene, pairs in (("aws_house", "12"), ("nexuiz_dieselpower", "5"))
        },
        "kitchen": Step([checked("kitchen", "--poses", "kitchen", *tabled)], (SET, MATCHABILITY), needs="photographs"),
        "fox": Step([checked("fox", "--images", "fox", *tabled)], (SET, MATCHABILITY), needs="photographs"),
        "plan-kitchen": Step(
            [checked("kitchen", "--poses", "kitchen"), planned("kitchen", "kitchen", *metric)],
            (SET,),
            needs="photographs",
        ),
        "plan-lund_door": Step(
            [checked("lund_door", "--images", "lund_door/images"), planned("lund_door", "lund_door/images")],
            (SET,),
            needs="photographs",
        ),
        "runtimes": Step(
            [
                (f"{benchmark}visibility.py", "--out", measured[0], "--device", device),
                (f"{benchmark}scorers.py", "--step", *("--landmarks", "24919", "--locations", "50", "--poses", "50"),
                 "--out", measured[1], "--device", device),
                (f"{benchmark}visibility.py", "--draw", str(RESULTS / RUNTIMES_CSV), *measured,
                 "--figures", "data/runtimes"),
            ],
            (SET, NETWORK),
            lambda: _copy(f"runtimes/{RUNTIMES_CSV}"),
        ),
        "hloc": Step(
            [
                study("compare_hloc", "compare", "--sets", "[building-700]", "--locations", "20",
                      "--work", "data/hloc", "--out", str(RESULTS / "hloc.csv"), "--device", device)
            ],
            (SET,),
        ),
        "panoramas": Step(
            [study("panoramas", "--scenes", f"[building-700, office-701, {', '.join(f'{meshes / name}.glb' for name in SCENES)}]",
                   "--out", str(RESULTS / "panoramas.csv"), "--device", device)],
            needs="meshes",
        ),
        "release": Step(
            [run("release", "", config="release")],
            (SET, MATCHABILITY, NETWORK, RESULTS / GENERALIZATION_CSV, RESULTS / GENERALIZATION_MD),
        ),
        "film": Step(
            [
                *(run(stage, "film", *film) for stage in ("scenes", "map", "sample")),
                run("compare-paths", "film", *film, *compared),
                ("wheretolook", "view", "--name", "film", *shown, "--film", "docs/images/lost.webp", "--device", device),
                run("relocalize", "film", *film, "--policies", "[even, gain]", "--film", "docs/images/relocalize.webp"),
            ],
            (SET,),
        ),
        "notebooks": Step([("notebooks/execute.py",)], sorted(RESULTS.glob("*.csv"))),
        "pictures": Step([study("pictures")], sorted(RESULTS.glob("*.csv"))),
        "pages": Step([], collect=_pages),
    }  # fmt: skip


def _copy(path: str) -> None:
    copy_file(Path("data", path), RESULTS / Path(path).name)


def _generalization() -> None:
    """Write the scores on the interiors with the weights that they are of."""
    table = pd.read_csv(Path("data/interiors/results") / SCORES_CSV)
    table.insert(0, "dataset", "interiors")
    table["weights_sha256"] = sha256(SET)
    write_text(RESULTS / GENERALIZATION_CSV, table.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def _looks() -> None:
    """Replace the rows of the test split."""
    table = pd.read_csv(Path("data/looks/results") / LOOKS_CSV)
    table.insert(0, "split", "test")
    replace_rows(RESULTS / LOOKS_CSV, table, ["split"], "%.4g")


def _paths() -> None:
    """Replace the rows of a scene, and combine those of all scenes."""
    table = replace_rows(RESULTS / PATHS_CSV, pd.read_csv(Path("data/test-90/results") / PATHS_CSV), ["scene"], "%.6g")
    of_scenes = table[table["scene"] != ALL]
    table = pd.concat([of_scenes, pooled_paths(of_scenes)], ignore_index=True)
    write_text(RESULTS / PATHS_CSV, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))


def _pages() -> None:
    """Fill in the numbers of README.md and docs/."""
    numbers = Numbers(Path())
    for page in pages(numbers):
        write_text(Path(page), updated(page, numbers))


def outdated(only: Sequence[str] = ()) -> Iterator[str]:
    """Yield the steps whose record is of other weights, tables or commands; with `only`, these."""
    for name in steps():
        made = read_json_object(MADE) if MADE.is_file() else {}
        step = steps()[name]  # with the tables of the steps before it
        is_current = bool(step.commands) and step.record().items() <= made.get(name, {}).items()
        if name in only or (not only and not is_current):
            yield name


def main(
    meshes: Path | None = None, photographs: Path | None = None, only: tuple[str, ...] = (), device: str = "auto"
) -> None:
    """Regenerate the results whose record is not of the shipped weights.

    Args:
        meshes: folder of the interiors by other authors.
        photographs: folder of the folders kitchen, fox and lund_door.
        only: names of steps, also current ones are then repeated.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """
    if unknown := {*only} - {*steps()}:
        raise ConfigError("unknown step", value=sorted(unknown), fix=f"Steps: {', '.join(steps())}.")
    given = {"": Path(), "meshes": meshes, "photographs": photographs}
    device = usable_device(device)
    for name in outdated(only):
        step = steps(meshes or Path(), photographs or Path(), device)[name]
        if given[step.needs] is None:
            print(f"{name}: left out, needs --{step.needs}")
            continue
        for words in step.commands:
            print(f"{name}: {' '.join(words)}", flush=True)
            module = () if words[0].endswith(".py") else ("-m",)
            subprocess.run([sys.executable, *module, *words], check=True)
        step.collect()
        if step.commands:
            made = read_json_object(MADE) if MADE.is_file() else {}
            record = {"version": VERSION, "device": device, **steps()[name].record()}
            write_json(MADE, made | {name: record})


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
