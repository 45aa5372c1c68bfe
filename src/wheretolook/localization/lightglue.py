"""Matches queries with mapping images by LightGlue (Lindenberger et al., ICCV 2023), as hloc does."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from wheretolook.features.extractor import EXTRACTORS, KINDS, Keypoints
from wheretolook.features.learned import kornia_feature, load_state, one_thread
from wheretolook.mapping.colmap_model import model_arrays, read_model
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.utils.errors import ConfigError, MapError, WeightsError


@dataclass(frozen=True, eq=False)
class _MappingImages:
    """Keypoints of the mapping images, by row of the image."""

    stored: list[tuple[NDArray[np.float32], NDArray[Any]]]
    sizes: NDArray[np.int64]  # (I, 2) width and height
    rows: list[NDArray[np.int64]]  # landmark row of each keypoint, -1 for none
    observer: NDArray[np.int64]  # (O,) image of each observation
    landmark: NDArray[np.int64]  # (O,) and its landmark


class LightGlueMatcher:
    """Matches queries with the mapping images that observe most of the landmarks that the query matched.

    `features` is the file of the mapping images' features, by default database.db in the map's folder. Raises
    ConfigError if LightGlue does not support the map's features or kornia is missing, MapError if the map's folder has no
    model or features, WeightsError if the weights cannot be used.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        map_dir: Path | None,
        weights: str,
        device: str = "cpu",
        features: Path | None = None,
    ) -> None:
        supported = {record.descriptors.name: record.lightglue for record in EXTRACTORS.values() if record.lightglue}
        if landmarks.features not in supported:
            fix = f"Leave LightGlue out, or map with one of {', '.join(supported)}."
            raise ConfigError("LightGlue does not support these features", value=landmarks.features, fix=fix)
        features = features or (None if map_dir is None else map_dir / "database.db")
        if map_dir is None or features is None or not features.is_file():
            fix = "Name it by --database, or map again with --mapping.keep_database true."
            raise MapError("LightGlue needs the features of the mapping images", path=features or map_dir, fix=fix)
        self.landmarks = landmarks
        self.map_dir = map_dir
        self.features = features
        self.device = torch.device(device)
        self.kind = KINDS[landmarks.features]
        self._network = _network(supported[landmarks.features], weights).to(self.device)

    def match(
        self, query: Keypoints, size: tuple[int, int], landmark_rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Match a query of a width and height, given the rows (M,) of the landmarks that it matched before.

        Returns rows of keypoints and rows of their landmarks, (M,) each.

        If several images lead to different landmarks for a keypoint, or keypoints for a landmark, the best score wins.
        """
        images = self._images
        voted = np.isin(np.arange(len(self.landmarks)), landmark_rows)[images.landmark]
        votes = np.bincount(images.observer[voted], minlength=len(images.stored))
        best = np.argsort(-votes, kind="stable")[:5]
        matches = [self._match_image(query, size, int(image)) for image in best[votes[best] > 0]]
        if not matches:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        keypoints, rows, scores = (np.concatenate(part) for part in zip(*matches, strict=True))
        order = np.lexsort((rows, keypoints, -scores))
        for values in (keypoints, rows):  # each keypoint once, then each landmark once
            order = order[np.sort(np.unique(values[order], return_index=True)[1])]
        order = order[np.argsort(keypoints[order])]
        return keypoints[order], rows[order]

    def _match_image(
        self, query: Keypoints, size: tuple[int, int], image: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
        """Keypoints, landmark rows and scores of matches with one mapping image."""
        pixels, stored = self._images.stored[image]
        data = {
            "image0": self._input(query.pixels, query.descriptors, size),
            "image1": self._input(pixels, self.kind.restore(stored), self._images.sizes[image]),
        }
        with torch.inference_mode(), one_thread():
            output = self._network(data)
        pairs = output["matches"][0].cpu().numpy()
        scores = output["scores"][0].float().cpu().numpy()
        rows = self._images.rows[image][pairs[:, 1]]
        return pairs[rows >= 0, 0], rows[rows >= 0], scores[rows >= 0]

    def _input(self, pixels: NDArray[Any], descriptors: NDArray[Any], size: ArrayLike) -> dict[str, torch.Tensor]:
        limit = np.asarray(size, dtype=np.float32)
        arrays = {"keypoints": np.clip(pixels, 0, limit), "descriptors": descriptors, "image_size": limit}
        return {name: torch.from_numpy(array).to(self.device)[None] for name, array in arrays.items()}

    @cached_property
    def _images(self) -> _MappingImages:
        model = read_model(self.map_dir)
        arrays = model_arrays(model)
        kind, stored = read_features(self.features, arrays.image_names)
        if kind is not self.kind:
            problem = f"the database holds {kind.name}, the landmarks are of {self.kind.name}"
            raise MapError(problem, path=self.features, fix="Map again.")
        point = arrays.point_ids[arrays.observation_point]
        row = np.minimum(np.searchsorted(self.landmarks.ids, point), len(self.landmarks) - 1)
        known = self.landmarks.ids[row] == point
        row = row[known]
        image = arrays.observation_image[known]
        keypoint = arrays.observation_keypoint[known]
        rows = [np.full(len(pixels), -1, dtype=np.int64) for pixels, _ in stored]
        for number, of_image in enumerate(rows):
            of_image[keypoint[image == number]] = row[image == number]
        cameras = [model.cameras[model.images[int(number)].camera_id] for number in arrays.image_ids]
        sizes = np.array([(camera.width, camera.height) for camera in cameras], dtype=np.int64)
        return _MappingImages(stored, sizes, rows, image, row)


def _network(features: str, weights: str) -> Any:
    """LightGlue for some features, with weights from a file, or "kornia" for its copy."""
    light_glue = kornia_feature().LightGlue
    settings = {name: value for name, value in light_glue.features[features].items() if name != "weights"}
    network = light_glue(features=None, **settings)
    name = "xfeat-lighterglue.pt" if features == "xfeat" else f"{features}_lightglue.pth"
    url = f"https://huggingface.co/kornia/lightglue/resolve/main/{name}"

    def prepare(state: dict[str, Any]) -> dict[str, Any]:
        """Rename the authors' keys to kornia's; XFeat's file holds its extractor, too, which is dropped."""
        known = network.state_dict()
        renamed = {}
        for key, value in state.items():
            name = re.sub(r"^(?:matcher\.)?(self_attn|cross_attn)\.(\d+)", r"transformers.\2.\1", key)
            name = name.removeprefix("matcher.")
            if name in known:
                renamed[name] = value
        return renamed

    file = "" if weights == "kornia" else weights
    load_state(network, file, name, [url], prepare, "--label.localizer.lightglue (of localize --lightglue)")
    first_weights = {"aliked": -0.3284747, "disk": -0.6789149}  # of the authors' files, whose tensors have equal shapes
    known = network.posenc.Wr.weight[0, 0].item()
    other = next((other for other, value in first_weights.items() if abs(known - value) < 1e-6), features)
    if other != features:
        problem = f"these are LightGlue weights for {other}, but the map has {features} features"
        raise WeightsError(problem, path=weights, fix=f"Give {name}.")
    return network.eval()
