"""Features by one network, but other weights than the map's, are rejected: they match hardly, without an error."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from colmap_models import camera, model_of
from features.test_extractors import untrained
from features.textures import color_texture
from mapping.test_hloc import SFM
from wheretolook.features.extractor import KINDS, ExtractorConfig, KeypointExtractor
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import model_arrays
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.select.image_localizer import ImageLocalizer
from wheretolook.utils.errors import MapError, MapWarning


def test_the_weights_are_compared_in_mapping_images(tmp_path):
    """Landmarks are the keypoints of one photograph, 2 m ahead."""
    rgb = color_texture(1)
    pinhole = PinholeCamera(320, 240, 200.0)
    (tmp_path / "other").mkdir()
    own, other = (
        ExtractorConfig("aliked", max_keypoints=200, weights=str(untrained("aliked", folder, seed)))
        for seed, folder in enumerate((tmp_path, tmp_path / "other"))
    )
    found = KeypointExtractor(own).extract(rgb)
    points = np.column_stack([(found.pixels - (160, 120)) / 200, np.ones(len(found))]) * 2
    tracks = [(point, [(0, row)]) for row, point in enumerate(points)]
    model = model_of(
        [camera(1, "PINHOLE", 320, 240, 200, 200, 160, 120)], [("0.png", 1, np.eye(3, 4), found.pixels)], tracks
    )
    landmarks = load_colmap_landmarks(tmp_path, reconstruction=model)
    landmarks = replace(landmarks, descriptors=KINDS["aliked"].store(found.descriptors), described_by="aliked")
    photographs = [(0, rgb, pinhole)]
    arrays = model_arrays(model)
    assert len(found) > 40
    assert Localizer(landmarks, pinhole, extractor=own).check_weights(arrays, photographs)
    assert not Localizer(landmarks, pinhole, extractor=own).check_weights(arrays, [])  # nothing to compare
    with pytest.raises(MapError, match="--extractor-weights"):
        Localizer(landmarks, pinhole, extractor=other).check_weights(arrays, photographs)


def test_without_photographs_names_state_the_weights(tmp_path):
    """hloc's features of the test are named feats-aliked-n16.h5."""
    weights = untrained("aliked", tmp_path)

    def opened(name):
        extractor = ExtractorConfig("aliked", weights=str(shutil.copy(weights, tmp_path / name)))
        return ImageLocalizer.open(SFM, extractor=extractor)

    with pytest.raises(MapError, match="aliked-n16"):
        opened("aliked-n16rot.pth")
    assert opened("aliked-n16.pth").features_from == "aliked aliked-n16"
    with pytest.warns(MapWarning, match="aliked-n16 are assumed to be by"):
        assert opened("mine.pth").features_from == "assumed: aliked mine"
