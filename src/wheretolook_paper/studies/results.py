"""Regenerate all results of the shipped weights: tables, the card, numbers of the pages, figures and notebooks. Resumes.

    python -m wheretolook_paper.studies.results --meshes MESHES --photographs PHOTOGRAPHS
    python -m wheretolook_paper.studies.results --meshes MESHES --only interiors cameras

`MESHES` holds the interiors by other authors that `data/release/results/generalization.md` names (GLB), `PHOTOGRAPHS` the
folders kitchen and fox (docs/results.md). Neither is part of the project: without them, steps that need them are left out.
`data/release/results/made.json` records for each step the weights, the device and the commands; a step whose record
agrees is not repeated. Labels and maps of interrupted steps are reused.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from jsonargparse import auto_cli

from wheretolook.evaluation.results import SCORES_CSV
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import copy_file, read_json_object, sha256, write_json, write_text
from wheretolook.utils.package import VERSION
from wheretolook_paper.evaluation.looks import LOOKS_CSV
from wheretolook_paper.paths.path_report import PATHS_CSV
from wheretolook_paper.release.card import GENERALIZATION_CSV
from wheretolook_paper.release.numbers import Numbers, pages, updated

RELEASE = Path("data/release")
RESULTS = RELEASE / "results"
MADE = RESULTS / "made.json"
WEIGHTS = [RELEASE / "weights" / f"{name}.safetensors" for name in ("set", "matchability", "mlp-2d+z")]
CAMERAS = {f"test-{angle}": ("--camera.fov_deg", str(angle)) for angle in (45, 60, 75, 90, 110)} | {
    "fisheye": ("--camera.model", "OPENCV_FISHEYE", "--camera.params", "[244.46, 244.46, 320, 240, 0, 0, 0, 0]")
}
"""Options of the cameras of the views; the last is equidistant, 150 degrees across."""

SCENES = ("aws_house", "nexuiz_aggressor", "nexuiz_aggressor_b", "nexuiz_desertfactory", "nexuiz_dieselpower",
          "nexuiz_dieselpower_b")  # fmt: skip
FEW = ("--sample.max_locations", "60", "--sample.max_directions", "14")

FILMED_PAIR = "1"
"""Start and goal of the film: a path on which looking ahead fails on a part."""

Words = Sequence[str]


@dataclass(frozen=True)
class Step:
    """A part of the results.

    Attributes:
        commands: arguments of `python -m`, run one after the other.
        collect: writes the release's tables from what the commands wrote.
        needs: folder that the user must give: "meshes", "photographs" or none.
    """

    commands: Sequence[Words]
    collect: Callable[[], None] = lambda: None
    needs: str = ""


def steps(meshes: Path = Path("MESHES"), photographs: Path = Path("PHOTOGRAPHS")) -> dict[str, Step]:
    """Return all steps by name, in an order in which each finds the tables of those before it."""
    scenes = ", ".join(f"{{path: {meshes / name}.glb, split: test}}" for name in SCENES)
    others = ("--scenes.meshes", f"[{scenes}]")
    bundled = ("--evaluate.weights", f"[{', '.join(map(str, WEIGHTS))}]")

    def demo(name: str, *options: str) -> tuple[str, ...]:
        return ("wheretolook", "demo", "--config", "configs/others.yaml", "--name", name, *others, *options)

    def on_looks(command: str, *options: str) -> tuple[str, ...]:
        return ("wheretolook", command, "--config", "configs/others.yaml", "--name", "looks", *options)

    def labelled(name: str, *options: str, sample: Words = (), label: Words = ()) -> list[Words]:
        words = ("--config", "configs/others.yaml", "--name", name, *options)
        stages = {"scenes": others, "map": ("--mapping.camera", "{fov_deg: 90}"), "sample": sample, "label": label}
        return [("wheretolook", stage, *words, *of_stage) for stage, of_stage in stages.items()]

    views = {name: labelled(name, *camera, sample=FEW if name == "fisheye" else ()) for name, camera in CAMERAS.items()}
    tested = ("--datasets", f"[{', '.join(f'data/{name}' for name in CAMERAS)}]", "--split", "test")
    cameras = ("wheretolook_paper.studies.cameras", *tested, "--out", str(RESULTS / "cameras.csv"))
    looks = labelled("looks", sample=("--sample.max_locations", "30", "--sample.max_directions", "50"),
                     label=("--label.store_pixels", "true"))  # fmt: skip
    ranked = on_looks("evaluate", "--evaluate.weights", f"[{WEIGHTS[0]}]", "--evaluate.methods", "[set, visible]")
    study = "wheretolook_paper.studies.photographs"
    film = ("--config", "configs/others.yaml", "--name", "film", "--scenes.test", "1")
    compared = ("--paths.methods", "[forward, set]", "--paths.pairs", "8")
    shown = ("--scene", "apartment-210", "--name", "film", "--path", "data/film/results/paths/apartment-210")
    photographed = ("--out", str(RESULTS / "photographs.csv"))
    return {
        "interiors": Step([demo("interiors", "--scenes.test", "0", *bundled)], _generalization, "meshes"),
        **{name: Step(commands, needs="meshes") for name, commands in views.items()},
        "cameras": Step([cameras], needs="meshes"),
        "looks": Step([*looks, ranked], _looks, "meshes"),
        "relocalize": Step([on_looks("relocalize")], lambda: _copy("looks", "relocalize.csv"), "meshes"),
        "paths": Step(
            [("wheretolook", "compare-paths", "--config", "configs/others.yaml", "--name", "test-90")],
            lambda: _copy("test-90", PATHS_CSV),
            "meshes",
        ),
        "kitchen": Step(
            [(study, "--poses", str(photographs / "kitchen"), "--work", "data/photographs/kitchen", *photographed)],
            needs="photographs",
        ),
        "fox": Step(
            [(study, "--images", str(photographs / "fox"), "--work", "data/photographs/fox", *photographed)],
            needs="photographs",
        ),
        "release": Step([("wheretolook", "release", "--config", "configs/release.yaml")]),
        "film": Step(
            [
                *(("wheretolook", stage, *film) for stage in ("scenes", "map")),
                ("wheretolook", "compare-paths", *film, *compared),
                ("wheretolook", "view", *shown, "--pair", FILMED_PAIR, "--film", "docs/images/lost.webp"),
            ]
        ),
        "pictures": Step([("wheretolook_paper.studies.pictures",)]),
        "pages": Step([], _pages),
        "notebooks": Step([], _notebooks),
    }


def _copy(dataset: str, name: str) -> None:
    copy_file(Path("data") / dataset / "results" / name, RESULTS / name)


def _generalization() -> None:
    """Write the scores on the interiors with the weights that they are of."""
    table = pd.read_csv(Path("data/interiors/results") / SCORES_CSV)
    table.insert(0, "dataset", "interiors")
    table["weights_sha256"] = sha256(WEIGHTS[0])
    write_text(RESULTS / GENERALIZATION_CSV, table.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def _looks() -> None:
    """Replace the rows of the test split."""
    table = pd.read_csv(Path("data/looks/results") / LOOKS_CSV)
    table.insert(0, "split", "test")
    before = pd.read_csv(RESULTS / LOOKS_CSV)
    table = pd.concat([before[before["split"] != "test"], table], ignore_index=True)
    write_text(RESULTS / LOOKS_CSV, table.to_csv(index=False, float_format="%.4g", lineterminator="\n"))


def _pages() -> None:
    """Fill in the numbers of README.md and docs/."""
    numbers = Numbers(Path())
    for page in pages(numbers):
        write_text(Path(page), updated(page, numbers))


def _notebooks() -> None:
    """Execute the notebooks of the checkout and store their outputs."""
    subprocess.run([sys.executable, "notebooks/execute.py"], check=True)


def outdated(only: Sequence[str] = ()) -> Iterator[str]:
    """Yield the steps whose tables are not of the shipped weights or of other commands."""
    made = read_json_object(MADE) if MADE.is_file() else {}
    for name, step in steps().items():
        record = made.get(name, {})
        if not only and step.commands and (record.get("weights"), record.get("commands")) == (_weights(), _texts(step)):
            continue
        if not only or name in only:
            yield name


def _weights() -> str:
    return sha256(WEIGHTS[0])[:16]


def _texts(step: Step) -> list[str]:
    return [" ".join(words) for words in step.commands]


def main(
    meshes: Path | None = None, photographs: Path | None = None, only: tuple[str, ...] = (), device: str = "auto"
) -> None:
    """Regenerate the results whose record is not of the shipped weights.

    Args:
        meshes: folder of the interiors by other authors.
        photographs: folder of the folders kitchen and fox.
        only: names of steps, also current ones are then repeated.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """
    if unknown := {*only} - {*steps()}:
        raise ConfigError("unknown step", value=sorted(unknown), fix=f"Steps: {', '.join(steps())}.")
    given = {"": Path(), "meshes": meshes, "photographs": photographs}
    for name in outdated(only):
        named = steps()[name]
        if given[named.needs] is None:
            print(f"{name}: left out, needs --{named.needs}")
            continue
        step = steps(meshes or Path(), photographs or Path())[name]
        for words in step.commands:
            chosen = ["--device", device] if words[0] == "wheretolook" else []
            print(f"{name}: {' '.join(words)}", flush=True)
            subprocess.run([sys.executable, "-m", *words, *chosen], check=True)
        step.collect()
        if not step.commands:
            continue
        made = read_json_object(MADE) if MADE.is_file() else {}
        record = {"weights": _weights(), "version": VERSION, "device": usable_device(device), "commands": _texts(named)}
        write_json(MADE, made | {name: record})


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
