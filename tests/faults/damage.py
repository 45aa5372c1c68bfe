"""Damage: files that a stage reads are removed, truncated, or have a bit flipped; disks are full."""

from __future__ import annotations

import random
import re
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from faults.cases import CHECK, CORRIDOR, SPACE, SYNTHETIC, Case, Workshop, stage
from faults.kills import Outcome, _labels_here
from faults.runs import Run, contents
from wheretolook.holdout.photo_map import WORK

WAYS = ("removed", "emptied", "truncated", "a bit flipped")

READERS = {
    "map": ("map", stage("map", "--label.workers", "1")),
    "sample": ("sample", stage("sample", "--sample.seed", "3")),
    "label": ("sample", stage("label", "--label.workers", "1")),
    "train": ("label", stage("train")),
    "evaluate": ("train", stage("evaluate")),
    "viewpoint-map": ("evaluate", stage("viewpoint-map", *SPACE)),
    "viewpoint-map with weights": ("evaluate", stage(
        "viewpoint-map", "--scene", "two", "--weights", "data/tiny/weights/mlp-2d.safetensors",
        "--viewpoint_map.grid", "[4,4,2]", "--viewpoint_map.directions", "20")),
    "release": ("evaluate", stage("release")),
    "select": ("evaluate", ["select", "--map", "data/tiny/two/map", "--at", "1,1,1.2", "--out", "views.csv",
                            "--directions", "20"]),
    "check": ("check", [*CHECK, "--workers", "1"]),
    "adapt --map": ("adapt --map", stage("adapt", *CORRIDOR, "--label.workers", "1")),
    "adapt, labels that are there": ("labelled", stage("adapt", *SYNTHETIC)),
    "adapt, labels of its own": ("adapt, labels of its own", stage("adapt", "--scene", "two", "--label.workers", "1")),
}  # fmt: skip
"""From which state, and what is run that reads the files."""

NOT_READ = ("/images/", "photographs/", ".csv", ".md", ".png", ".txt")


def planned(workshop: Workshop, readers: Sequence[str], n: int, rng: random.Random) -> list[tuple[str, str, str]]:
    """Readers, files and ways to damage them: every kind of file in every way, as often as any other."""
    chosen = []
    for reader in readers:
        paths = contents(workshop.state(READERS[reader][0]))
        files = [path for path in paths if f"/{WORK}/" in path or not any(part in path for part in NOT_READ)]
        chosen += [(reader, file, way) for file in files for way in WAYS if not file.endswith("/")]
    rng.shuffle(chosen)
    return (chosen * (n // max(1, len(chosen)) + 1))[:n]


def damaged(workshop: Workshop, reader: str, file: str, way: str, rng: random.Random) -> Outcome:
    """Damage a file and run what reads it: it finishes, or says which file it is."""
    start = time.monotonic()
    state, arguments = READERS[reader]
    workshop.restore(state)
    path = workshop.folder / file
    outcome = Outcome(reader, way, file)
    content = bytearray(path.read_bytes())
    if way == "removed":
        path.unlink()
    elif way == "emptied":
        path.write_bytes(b"")
    elif way == "truncated":
        path.write_bytes(content[: rng.randrange(1, max(2, len(content)))])
    else:
        place = rng.randrange(len(content))
        content[place] ^= 1 << rng.randrange(8)
        path.write_bytes(content)
        outcome.at += f", byte {place}"
    run = Run(workshop.folder, arguments).start(_labels_here)
    try:
        code = run.wait(120)
    except TimeoutError as error:
        outcome.problems.append(f"it hangs: {error}")
        return outcome
    outcome.ended = {0: "finished", 2: "refused"}.get(code, f"exit code {code}")
    said = run.err
    if code not in (0, 2) or "Traceback" in said:
        outcome.problems.append(f"ended with {code}: {said[-1500:]}")
    elif code == 2 and not _names(said, file):
        outcome.problems.append(f"the file is not named: {said[-600:]}")
    outcome.seconds = time.monotonic() - start
    return outcome


def _names(said: str, file: str) -> bool:
    """Whether an error names a file, or for parts of a COLMAP model its folder."""
    path = Path(file)
    if path.name == "stages.json" and "stage has not been run for this scene" in said:  # which is what it told
        return f"{path.parent}:" in said
    if "trained on other data than the dataset now holds" in said:  # as is true of a damaged scene
        return True
    return path.name in said or (path.suffix == ".bin" and bool(re.search(r"map\b", said)))


def full_disk(workshop: Workshop, case: Case, rng: random.Random) -> Outcome:
    """Run a case on a file system with too little room, then with enough."""
    start = time.monotonic()
    outcome = Outcome(case.name, "full disk", "")
    shutil.rmtree(workshop.folder, ignore_errors=True)
    workshop.folder.mkdir()
    before, after = (_size(workshop.state(name)) for name in (case.before, case.after or case.name))
    share = rng.uniform(0, 0.9)
    room = before + int(max(after - before, 2**16) * share)
    outcome.at = f"room for {share:.0%} of what is new"
    _mount(workshop.folder, f"size={(room // 4096 + 8) * 4096}")
    try:
        (workshop.folder / "mlruns").mkdir()
        _mount(workshop.folder / "mlruns", "size=1g")  # what MLflow does on a full disk is tested elsewhere
        try:
            shutil.copytree(workshop.state(case.before), workshop.folder, dirs_exist_ok=True)
            run = Run(workshop.folder, case.arguments).start()
            code = run.wait(300)
            outcome.ended = {0: "finished", 2: "refused"}.get(code, f"exit code {code}")
            if code not in (0, 2) or "Traceback" in run.err:
                outcome.problems.append(f"ended with {code}: {run.err[-1500:]}")
            elif code == 2:
                if not re.search(r"error: \S*/\S+: .*(No space left|cannot be written)", run.err):
                    outcome.problems.append(f"the file is not named: {run.err[-600:]}")
                left = [path for path in contents(workshop.folder) if ".partial" in path or "/." in path]
                outcome.problems += [f"left on a full disk: {path}" for path in left]
            subprocess.run(["mount", "-o", "remount,size=1g", str(workshop.folder)], check=True)
            again = Run(workshop.folder, case.rerun).start(_labels_here)
            if again.wait(300) != 0:
                outcome.problems.append(f"the next run: {again.err[-1500:]}")
            else:
                outcome.problems += workshop.differences(case)
            outcome.problems += [f"still running: {one}" for one in [*run.outlived_by(), *again.outlived_by()]]
        except TimeoutError as error:
            outcome.problems.append(f"it hangs: {error}")
        finally:
            subprocess.run(["umount", "-l", str(workshop.folder / "mlruns")], check=True)
    finally:
        subprocess.run(["umount", "-l", str(workshop.folder)], check=True)
    outcome.seconds = time.monotonic() - start
    return outcome


def _mount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)


def _size(folder: Path) -> int:
    """Bytes that a folder takes on a disk, without its MLflow store."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.relative_to(folder).parts[0] != "mlruns"]
    return sum((path.stat().st_size + 4095) // 4096 * 4096 for path in files)
