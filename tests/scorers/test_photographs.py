"""Log-odds of maps of photographs have the offset of the weights once; those of maps of renders have none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, logit

from selection.room import write_room
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.weights import load_scorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.package import WEIGHTS, shipped
from wheretolook_paper.studies.calibrate_photographs import fitted_offset


@pytest.mark.parametrize("rendered", [True, False])
def test_the_offset_is_added_once_and_only_for_photographs(rendered, tmp_path):
    folder = write_room(tmp_path / "sparse", metric=rendered)  # whose report then states that it is rendered
    trained = replace(
        TrainedNetwork.load(shipped(WEIGHTS) / "set.safetensors", SetNetwork, "set"), photograph_offset=0.7
    )
    trained.save(tmp_path / "with.safetensors")
    replace(trained, photograph_offset=0.0).save(tmp_path / "without.safetensors")
    TrainedNetwork.load(tmp_path / "with.safetensors", SetNetwork, "set").save(tmp_path / "again.safetensors")
    expected = 0.0 if rendered else 0.7
    for localization_map in (
        LocalizationMap.from_colmap(folder),
        Scene.of_colmap(ColmapFiles(folder)).localization_map,
    ):
        views = localization_map.mapping_poses
        assert views is not None
        plain, *others = (
            load_scorer(localization_map, tmp_path / f"{name}.safetensors") for name in ("without", "with", "again")
        )
        for scorer in others:
            np.testing.assert_allclose(logit(scorer.score(views)) - logit(plain.score(views)), expected, atol=1e-6)


def test_the_offset_of_several_places_is_fitted_with_equal_weights():
    """Probabilities that are too low by 1 in log-odds on one place and by 0 on one of ten times the views."""
    rng = np.random.default_rng(0)
    places = []
    for shift, n in ((1.0, 20_000), (0.0, 200_000)):
        log_odds = rng.normal(size=n)
        places.append((log_odds, rng.random(n) < expit(log_odds + shift)))
    assert fitted_offset(places[:1]) == pytest.approx(1.0, abs=0.05)
    assert fitted_offset(places) == pytest.approx(0.5, abs=0.05)
