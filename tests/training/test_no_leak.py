"""Nothing that is known only after localization reaches a score: learners see the map, the poses and the labels."""

import shutil

import numpy as np
import pytest

from learning_options import train_config
from synthetic_dataset import make_dataset
from wheretolook.commands.evaluate import evaluate_methods as evaluate
from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_files import read_table, write_table
from wheretolook.dataset.viewpoint_table import LOCALIZED, is_good
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.scorers.registry import learned
from wheretolook.tracking import TrackingConfig
from wheretolook.training.weights import read_weights

pytestmark = pytest.mark.usefixtures("no_pictures")

METHODS = tuple({"mlp-2d+3d", "trees", "set"} & {*learned()})
CONFIG = train_config(
    *METHODS,
    epochs=2,
    trees={"max_trees": 5, "min_leaf": 5},
    set={"epochs": 1, "landmarks": 16, "batch_size": 16, "enlarged": 1.0},  # enlarged, labels follow from errors
    matchability={"epochs": 1},
    accelerator="cpu",
)


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    return TrackingConfig(folder=str(tmp_path_factory.mktemp("mlruns")))


def same_labels_other_outcomes(source, root):
    """The dataset with the same labels, but other errors, other failures and other numbers of inliers."""
    shutil.copytree(source.root, root, ignore=shutil.ignore_patterns("weights", "results"))
    dataset = Dataset.load(root)
    for number, scene in enumerate(dataset.scenes):
        rng = np.random.default_rng(number)
        table = read_table(scene.table)
        good = is_good(table)
        n = len(table)
        table = table.assign(
            status=np.where(good, LOCALIZED, rng.choice(["no_pose", "too_few_matches"], n)),
            error_m=np.where(good, rng.uniform(0, 0.049, n), np.nan),
            error_deg=np.where(good, rng.uniform(0, 0.39, n), np.nan),
            n_inliers=rng.integers(0, 500, n).astype(np.int32),
            n_visible=rng.integers(0, 500, n).astype(np.int32),
        )
        assert np.array_equal(is_good(table), good)
        write_table(table, scene.table)
    return dataset


def test_only_the_labels_reach_a_learner(tmp_path, tracking):
    one = make_dataset(tmp_path / "one", n_locations=12, n_directions=12)
    other = same_labels_other_outcomes(one, tmp_path / "other")
    assert other.fingerprint() != one.fingerprint()
    for first, second in zip(*(train(data, CONFIG, tracking, progress=False) for data in (one, other)), strict=True):
        tensors, others = (read_weights(model.path)[0] for model in (first, second))
        assert all(np.array_equal(tensors[name], others[name]) for name in tensors), first.method
    config = EvaluateConfig(methods=("bins", *METHODS), top_n=(1,), resamples=10)
    columns = ["method", "raw_0.05m_0.4deg", "roc_auc", "average_precision"]
    tables = [evaluate(data, config, tracking, progress=False)[columns] for data in (one, other)]
    assert tables[0].equals(tables[1])
