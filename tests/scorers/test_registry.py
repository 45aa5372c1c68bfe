"""Methods of other packages, families of methods, and which weights are preferred."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import wheretolook
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.scorers import registry
from wheretolook.scorers.registry import all_methods, make_scorer, methods_named, scorers
from wheretolook.scorers.visible import METHODS
from wheretolook.scorers.weights import load_scorer, resolve_weights
from wheretolook.tracking import TrackingConfig, client
from wheretolook.training.weights import read_weights, write_weights
from wheretolook.utils.errors import ConfigError, WeightsError

SOURCE = Path(wheretolook.__file__).parent
WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights"

PLUGIN = '''
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from wheretolook.scorers.base import CountingScorer
from wheretolook.scorers.registry import Learner, Method


@dataclass(frozen=True)
class LinearConfig:
    """Options of a line through the number of landmarks.

    Args:
        slope: weight of a landmark.
    """

    slope: float = 0.1


class Line(CountingScorer):
    name = "linear"
    slope = 1.0
    middle = 0.0

    def score_counts(self, n_visible, n_filled):
        return 1 / (1 + np.exp(-self.slope * (n_visible - self.middle)))


class Model:
    def __init__(self, camera, slope, middle):
        self.camera, self.numbers = camera, {"slope": slope, "middle": middle}

    def save(self, path, training=None):
        from wheretolook.training.weights import write_weights

        header = {"camera": asdict(self.camera), "numbers": self.numbers, "training": training or {}}
        write_weights(path, "linear", {}, header)


def learn(task):
    from wheretolook.training.learner import TrainingResult

    counts = np.concatenate([scene.read_table()["n_visible"] for scene in task.dataset.split("train")])
    metrics = {"val_average_precision": 0.5}
    return TrainingResult(Model(task.dataset.camera, task.options.slope, float(np.median(counts))), metrics, {"n": len(counts)})


def build(localization_map, options):
    from wheretolook.training.weights import read_weights

    line = Line(localization_map)
    numbers = read_weights(Path(options.weights))[1]["numbers"]
    line.slope, line.middle = numbers["slope"], numbers["middle"]
    return line


class Fewest(CountingScorer):
    name = "fewest"

    def score_counts(self, n_visible, n_filled):
        return 1 / (1.0 + n_visible)


METHODS = (
    Method("linear", "A line through the number of landmarks in view.", build, "linear", probability=True,
           learner=Learner(learn, LinearConfig)),
    Method("fewest", "The fewest landmarks in view.", lambda localization_map, options: Fewest(localization_map)),
)
'''

PROGRAM = """
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from box_scenes import box_quads, quads_mesh, random_texture
from planning.rooms import patiently
from synthetic_dataset import make_dataset
from wheretolook.cli import parse_command
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook_paper.figures.scores import score_figure
from wheretolook.scenes.loading import save_glb
from wheretolook.commands.evaluate import evaluate_methods
from wheretolook.commands.train import train_methods
from wheretolook.utils.files import write_json
from wheretolook.tracking import newest_run
from wheretolook.tracking import TrackingConfig

Figure.savefig = lambda figure, file, **options: file.write(b"")  # figures are built, which is enough here
folder = Path(sys.argv[1])
dataset = make_dataset(folder / "tiny", ("train", "test"), n_locations=8, n_directions=12)
room = box_quads((-3.1, -3.1, -0.1), (3.1, 3.1, 2.6), inward=True)
for scene in dataset.scenes:
    save_glb(quads_mesh(room, [random_texture(np.random.default_rng(0), 8, 8)]), scene.mesh)
    write_json(scene.folder / "stages.json", {"scenes": "made", "map": "made"})
tracking = TrackingConfig(str(folder / "mlruns"))
experiment = parse_command("train", ["--train.methods", "[linear]", "--train.linear.slope", "0.2"])
assert experiment.train.linear.slope == 0.2
(model,) = train_methods(dataset, experiment.train, tracking, progress=False)
assert model.path == dataset.root / "weights" / "linear.safetensors"
assert train_methods(dataset, experiment.train, tracking, progress=False)[0].reused
table = evaluate_methods(dataset, EvaluateConfig(("random", "bins", "linear", "fewest"), resamples=20), tracking)
assert {*table["method"]} == {"random", "bins", "linear", "fewest", "oracle"}
assert (table["reference"] == "linear").all() and table.loc[table["method"] == "linear", "ece"].notna().all()
labels = [text.get_text() for text in score_figure(table).axes[0].get_yticklabels()]
assert sorted(labels) == ["fewest", "linear", "random", "reprojections with bins"], labels
options = ["--data", str(folder), "--name", "tiny", "--tracking.folder", tracking.folder, "--device", "cpu",
           "--camera.width", "160", "--camera.height", "120", "--camera.focal_px", "80",
           "--scene", dataset.split("test")[0].name, "--start", "[-1, -1, 1]", "--goal", "[1, 1, 1]",
           "--method", "linear", "--plan.against", "[fewest]", "--film", "none",
           "--plan.grid", "[3, 3, 2]", "--plan.directions", "20"]
experiment = parse_command("plan", options)


def plan_within(seconds):
    planner = replace(experiment.plan.planner, time_s=seconds)
    return replace(experiment, plan=replace(experiment.plan, planner=planner)).run()


path = patiently(plan_within)
assert path.scores.max() > 0.5 and path.scores.max() <= 1, path.scores
assert newest_run(tracking, "plan").data.params["methods"] == "fewest linear"
print("trained, compared, drawn and planned with")
"""


def run_python(program, *arguments, path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@pytest.mark.slow
def test_another_package_adds_a_learner_and_a_rule(tmp_path):
    installed = tmp_path / "site"
    about = installed / "wheretolook_linear-1.0.dist-info"
    about.mkdir(parents=True)
    (installed / "wheretolook_linear.py").write_text(PLUGIN)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: wheretolook-linear\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[wheretolook.methods]\nlinear = wheretolook_linear:METHODS\n")
    client(TrackingConfig(str(tmp_path / "mlruns")))  # a copy of an empty store: MLflow takes seconds to make its own
    tests = Path(__file__).parents[1]
    done = run_python(PROGRAM, str(tmp_path), path=[installed, SOURCE.parent, tests])
    assert done.returncode == 0, done.stderr[-3000:]
    assert "trained, compared, drawn and planned with" in done.stdout


@pytest.mark.parametrize(
    "value", ["nowhere.at.all:METHOD", "math:pi", "os:environ", "wheretolook.scorers.visible:METHODS"]
)
def test_invalid_methods_of_other_packages(value, monkeypatch):
    monkeypatch.setattr(registry, "entry_points", lambda group: [EntryPoint("broken", value, registry.GROUP)])
    with pytest.raises(ConfigError):
        all_methods.__wrapped__()


LIGHT = """
import sys
from wheretolook.scorers.registry import describe_methods
from wheretolook.scorers.train_config import TrainConfig
TrainConfig(), describe_methods()
print([name for name in ("torch", "lightning", "pandas", "mlflow", "warp", "scipy") if name in sys.modules])
"""


def test_records_of_methods_are_light():
    done = run_python(LIGHT, path=[SOURCE.parent])
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_families_stand_for_their_methods():
    names = [method.name for method in methods_named(("mlp", "bins"), scorers())]
    assert names == ["mlp-2d", "mlp-2d+z", "mlp-2d+3d", "mlp-2d+3d+landmark", "mlp-released", "bins"]
    assert len(methods_named(("fisher",), scorers())) == 9
    for wrong in ((), ("bins", "bins"), ("psychic",), ("",), ("matchability",)):
        with pytest.raises(ConfigError):
            methods_named(wrong, scorers())
    assert all(method.name == name and METHODS[0] for name, method in all_methods().items())


def test_an_attribute_that_maps_do_not_know_is_named(tmp_path):
    tensors, header = read_weights(WEIGHTS / "set.safetensors")
    header.pop("format_version")
    header["attributes"] = ["colour" if name == "ambiguity" else name for name in header["attributes"]]
    write_weights(tmp_path / "set.safetensors", "set", tensors, header)
    localization_map = LocalizationMap(
        Map(make_landmarks(np.random.default_rng(0), 20)), replace(CAMERA, focal_px=80.0)
    )
    with pytest.raises(WeightsError):
        load_scorer(localization_map, tmp_path / "set.safetensors")
    views = poses_looking_along(np.zeros((1, 3)), np.ones((1, 3)))
    assert make_scorer("visible", localization_map).score(views).shape == (1,)


def test_weights_of_many_cameras_come_before_those_of_one(tmp_path):
    """Precision on views of many cameras is lower than on those of one, and does not rank weights."""
    localization_map = LocalizationMap(Map(make_landmarks(np.random.default_rng(0), 50)), CAMERA)
    for name in ("set", "matchability", "mlp-2d+z"):
        for suffix in ("safetensors", "json"):
            shutil.copy(WEIGHTS / f"{name}.{suffix}", tmp_path)
    for precision, camera, best in ((0.1, None, "set"), (0.1, CAMERA.record(), "mlp-2d+z")):
        path = tmp_path / "set.safetensors"
        tensors, header = read_weights(path)
        header.pop("format_version")
        write_weights(path, "set", tensors, {**header, "camera": camera})
        record = json.loads(path.with_suffix(".json").read_text())
        record["metrics"]["val_average_precision"] = precision
        path.with_suffix(".json").write_text(json.dumps(record))
        assert resolve_weights(path=tmp_path).stem == best
        if best == "set":
            assert load_scorer(localization_map, tmp_path).name == "set"


NEW_ATTRIBUTE = """
import sys
import numpy as np
from pathlib import Path
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.weights import load_scorer

weights, out = Path(sys.argv[1]), Path(sys.argv[2])
rng = np.random.default_rng(1)
views = poses_looking_along(rng.uniform((-1, -1, 1), (1, 1, 2), (40, 3)), rng.normal(size=(40, 3)))
at = LocalizationMap(Map(make_landmarks(np.random.default_rng(0), 200)), CAMERA)
wide = LocalizationMap(at.map, type(CAMERA)(640, 480, 320.0))
scores = {name: load_scorer(wide, weights / f"{name}.safetensors").score(views) for name in ("set", "mlp-2d+z")}
scores["expected"] = make_scorer("expected-bins", wide, weights=weights / "matchability.safetensors").score(views)
scores["n_attributes"] = np.array([len(MAP_ATTRIBUTES)])
np.savez(out, **scores)
"""


def test_a_new_attribute_leaves_shipped_weights_as_they_are(tmp_path):
    """Adding an attribute to two files leaves the scores of bundled weights identical."""
    changed = tmp_path / "changed"
    shutil.copytree(SOURCE, changed / "wheretolook", ignore=shutil.ignore_patterns("__pycache__"))
    for file, old, new in (
        ("landmarks.py", "MAP_ATTRIBUTES = (", 'MAP_ATTRIBUTES = (\n    "height",'),
        ("landmarks.py", '"track_length": np.log', '"height": self.points[:, 2],\n            "track_length": np.log'),
    ):
        path = changed / "wheretolook" / "mapping" / file
        text = path.read_text()
        assert text.count(old) == 1
        path.write_text(text.replace(old, new))
    runs = []
    for place in (SOURCE.parent, changed):
        out = tmp_path / f"{len(runs)}.npz"
        done = run_python(NEW_ATTRIBUTE, str(WEIGHTS), str(out), path=[place, Path(__file__).parents[1]])
        assert done.returncode == 0, done.stderr[-3000:]
        runs.append(dict(np.load(out)))
    assert runs[1].pop("n_attributes") == runs[0].pop("n_attributes") + 1
    for name, scores in runs[0].items():
        np.testing.assert_array_equal(runs[1][name], scores)
        assert len(np.unique(scores)) > 20
