"""Localizes images in a COLMAP model, among all of its landmarks or those of retrieved mapping images (hloc's pairs)."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from tqdm.auto import tqdm

from wheretolook.dataset.config import ACCURACY, CONTRADICTED, LOCALIZED, Accuracy, checked_accuracy
from wheretolook.features.extractor import EXTRACTORS, KINDS, ExtractorConfig, Keypoints
from wheretolook.features.matches import Matches
from wheretolook.geometry.poses import Float
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import IDENTITY, Look, PosePrior, checked_turns, matches_among, read_turns
from wheretolook.localization.rig_localization import POSES_OF_A_VIEW, POSES_OF_AN_IMAGE, JointLocalizer
from wheretolook.mapping.colmap_model import ModelArrays, observation_matrix
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.feature_files import HDF5_SUFFIXES, weights_in_name
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map, extractor_of, find_features
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.select.localized import Localized
from wheretolook.select.query_images import (
    KnownCamera,
    QueryImage,
    QueryImages,
    cut_panorama,
    distinct_names,
    is_panorama,
)
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, PoseError, TableError, WhereToLookError
from wheretolook.utils.files import path_ends, read_text


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """The mapping images paired with each query, and the landmarks that they observe."""

    path: Path
    images: dict[str, list[int]]  # rows of mapping images in the model, by the query's name in the file
    observed: csr_array  # (I, N) which landmarks they observe

    @classmethod
    def read(cls, path: Path, model: ModelArrays) -> ImagePairs:
        """Read a file with lines "query mapping_image", given a model whose points are its landmarks.

        Raises TableError if a line is not two names, or no image of the model is named.
        """
        images: dict[str, list[int]] = defaultdict(list)
        row_of = {name: row for row, name in enumerate(model.image_names)}
        try:
            lines = read_text(path, 2**28).splitlines()
        except (OSError, ValueError) as error:
            raise TableError(f"the pairs of images cannot be read: {error}", path=path) from error
        for number, line in enumerate(lines, 1):
            names = line.split()
            if len(names) not in (0, 2):
                fix = "Give hloc's file of pairs: a query and a mapping image in each line."
                raise TableError(f"line {number} is not a pair of images", path=path, value=line[:80], fix=fix)
            if names:
                images[names[0]] += [row_of[name] for name in names[1:] if name in row_of]
        if not any(images.values()):
            fix = f"Its images have names such as {model.image_names[0]}." if model.image_names else ""
            raise TableError("no mapping image of the pairs is in the model", path=path, fix=fix)
        return cls(path, images, observation_matrix(model))

    def landmarks(self, query: str) -> NDArray[np.int64]:
        """Return the rows of the landmarks of a query, by its path or the end of it. Raises TableError if it has none."""
        names = path_ends(PurePath(query))
        found = next((self.images[name] for name in names if name in self.images), None)
        if found is None:
            ends = [rows for name, rows in self.images.items() if PurePath(name).name == names[-1]]
            if len(ends) != 1:
                fix = "Name it in the first column."
                raise TableError("the pairs do not name this image", path=self.path, value=query, fix=fix)
            found = ends[0]
        return np.unique(self.observed[found].indices).astype(np.int64)


Image = str | Path | NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class ImageLocalizer:
    """Localizes images, one at a time or as a rig, by several hypotheses and guided matching.

    `landmarks` are in the world; images and poses of users are in the map's own `frame`.
    """

    landmarks: Landmarks
    frame: MapFrame
    images: QueryImages
    extractor: ExtractorConfig
    device: str = "cpu"
    pairs: ImagePairs | None = None
    lightglue: str = ""  # as in `LocalizerConfig`
    features: Path | None = None  # of the mapping images, which LightGlue matches
    photographs: bool = False  # whether the mapping images are photographs

    @classmethod
    def open(
        cls,
        path: Path,
        database: Path | None = None,
        frame: FrameOptions = FrameOptions(),
        extractor: ExtractorConfig | None = None,
        device: str = "cpu",
        pairs: Path | None = None,
        lightglue: str = "",
    ) -> ImageLocalizer:
        """Open a COLMAP model with its descriptors: a database or HDF5 file, by default the one near the model.

        A map of this project has them in its file of landmarks. `pairs` is hloc's file of each image's mapping images,
        `lightglue` as in `LocalizerConfig`. Raises MapError if the model cannot be read, or there
        are no descriptors, or none of the extractor's kind; ConfigError if an option is invalid.
        """
        opened = Map.open_described(path, database, frame, device)
        landmarks = opened.landmarks
        assert opened.images is not None
        learned = not KINDS[landmarks.features].in_bytes
        features = database or (find_features(path) if lightglue or learned else None)
        extractor = extractor or extractor_of(path, KINDS[landmarks.features])
        of_images = None if pairs is None else ImagePairs.read(pairs, opened.images)
        result = cls(
            landmarks,
            opened.frame,
            QueryImages(opened),
            extractor,
            device,
            of_images,
            lightglue,
            features,
            opened.has_photographs,
        )
        _ = (
            result._localizer.extractor,
            result.features_from,
        )  # so that other features and missing weights are reported once
        return result

    @cached_property
    def features_from(self) -> str:
        """The extractor of images; "assumed: ..." if it is not known that the map's features have its weights.

        Learned descriptors are compared in two photographs, otherwise by the files' names. A `MapWarning` names weights
        that are assumed. Raises MapError for others than the map's.
        """
        weights = self.extractor.weights or EXTRACTORS[self.extractor.method].weights
        used = weights_in_name(weights)
        extractor = f"{self.extractor.method} {used or Path(weights).stem}".strip()
        if self._localizer.kind.in_bytes:
            return extractor
        images = self.images.mapping
        photographs: list[Any] = []
        for row in np.argsort(-np.bincount(images.observation_image, minlength=len(images.image_ids)), kind="stable"):
            name = images.image_names[row]
            path = self.images.photograph(name) if len(photographs) < 2 else None
            if path is not None:
                image = self.images.read(path, name, self.images.cameras[int(images.image_cameras[row])])
                photographs.append((int(row), image.rgb, image.camera))
        if self._localizer.check_weights(images, photographs):
            return extractor
        of_map = "" if self.features is None else weights_in_name(self.features)
        if used and of_map and used != of_map:
            fix = f"Give --extractor {self.extractor.method} --extractor-weights {of_map}.pth."
            raise MapError(f"the map has features of {of_map}", path=self.features, value=weights, fix=fix)
        if used == of_map or self.features is None or self.features.suffix not in HDF5_SUFFIXES:
            return extractor
        text = f"{self.features}: features of {of_map or self.landmarks.features} are assumed to be by {weights}"
        warnings.warn(text, MapWarning, stacklevel=3)
        return f"assumed: {extractor}"

    @cached_property
    def _localizer(self) -> Localizer:
        config = LocalizerConfig(method="hypotheses", lightglue=self.lightglue)
        camera = next(iter(self.images.cameras.values()))
        map_dir = self.images.folder
        return Localizer(
            self.landmarks, camera, config, self.extractor, self.device, map_dir, self.features, self.photographs
        )

    @cached_property
    def _rigs(self) -> JointLocalizer:
        # given rotations have a standard deviation of 0.2 degrees about each axis
        return JointLocalizer(self._localizer.estimator, 0.2, True, self._localizer.expected)

    def localize(
        self,
        images: Image | Sequence[Image],
        turns: str | Path | ArrayLike | None = None,
        camera: KnownCamera | int | str | Path | None = None,
        prior: Sequence[float] | None = None,
        accuracy: Accuracy = ACCURACY,
        names: Sequence[str] | None = None,
    ) -> Localized:
        """Localize an image, or several from one location of which the rotations are known.

        Args:
            images: a file, or an array (H, W, 3) uint8 RGB; with `turns` several.
            turns: rotations `cam_from_rig` (N, 3, 3), or poses (N, 3, 4) in metres; or a file, see
                `wheretolook.localization.rig.read_turns`.
            camera: of the images, or its camera_id in the model, or a file, see `QueryImages.known_camera`; "panorama" for
                an equirectangular image; None to assume the model's, or the EXIF focal length, see `QueryImages`.
            prior: rough location x, y, z of the camera in the map, and perhaps yaw in degrees of an image: one more
                hypothesis, which wins only if the matches support it best.
            accuracy: limits in metres and degrees that the probability refers to.
            names: of the images in the result; by default `distinct_names` of the files.

        Raises:
            MapError, PoseError, ConfigError: an image cannot be read or is none, its camera is unknown or other than
                given, or there are several without turns.
            TableError, PoseError: the file of turns, or a rotation, is not valid.
        """
        given = [images] if isinstance(images, (str, Path, np.ndarray)) else images
        if not isinstance(given, Sequence) or not all(isinstance(one, (str, Path, np.ndarray)) for one in given):
            raise PoseError("images are files or arrays (H, W, 3)", value=type(images).__name__)
        paths = [str(n) if isinstance(image, np.ndarray) else str(image) for n, image in enumerate(given)]
        cam_from_rig: Float = IDENTITY[None]
        if isinstance(turns, (str, Path)):
            cam_from_rig = self._usable(read_turns(Path(turns), paths))
        elif turns is not None:
            cam_from_rig = self._usable(checked_turns(turns, len(given)))
        if len(given) != len(cam_from_rig) or not given:
            fix = "Give one image, or turns."
            raise ConfigError("several images are localized together by their rotations", value=len(given), fix=fix)
        known = camera if isinstance(camera, Mapping) else self.images.known_camera(camera)
        names = names or distinct_names([Path(path) for path in paths])
        queries = [self.images.read(image, name, known) for image, name in zip(given, names, strict=True)]
        if len(queries) > 1 and any(is_panorama(query.camera) for query in queries):
            raise ConfigError("several panoramas are not localized together: leave the turns out", value=names)
        near = None if prior is None else PosePrior.of(prior, self.frame.world_from_map)
        limits = checked_accuracy(accuracy, self.landmarks.mapping_distance_m)
        exact = self._localizer.joint  # rotations
        if len(queries) == 1 and is_panorama(queries[0].camera):
            faces, cam_from_rig = cut_panorama(queries[0])
            if near is not None:
                near = replace(near, yaw_deg=None)  # faces look all around
            return self._localize(paths * len(faces), faces, cam_from_rig, near, limits, exact).of_panorama(queries[0])
        rig = self._rigs if len(queries) > 1 else exact
        results = [self._localize(paths, queries, cam_from_rig, near, limits, rig)]
        if len(queries) == 1:
            (query,) = queries
            readings = [*query.others]
            if query.quarters and not self._localizer.kind.in_bytes:  # learned features change as an image turns
                readings.append(replace(query, is_turned=True))
            results += [self._localize(paths, [reading], cam_from_rig, near, limits, rig) for reading in readings]
        return max(results, key=lambda result: (result.status in (LOCALIZED, CONTRADICTED), result.n_inliers))

    def localize_each(
        self,
        paths: Sequence[Path],
        names: Sequence[str],
        camera: KnownCamera | int | str | Path | None = None,
        prior: Sequence[float] | None = None,
        accuracy: Accuracy = ACCURACY,
    ) -> Iterator[Localized]:
        """Yield the result of `localize` for each image, with a progress bar; the status "error" where that raises.

        Raises ConfigError if the prior is invalid.
        """
        if prior is not None:
            PosePrior.of(prior, self.frame.world_from_map)
        for path, name in zip(tqdm(paths, desc="localize", unit="image"), names, strict=True):
            try:
                result = self.localize(path, None, camera, prior, accuracy, [name])
            except WhereToLookError as error:
                result = Localized((name,), "error", str(error), frame=self.frame)
            yield result

    def _localize(
        self,
        paths: Sequence[str],
        queries: Sequence[QueryImage],
        cam_from_rig: Float,
        near: PosePrior | None,
        limits: Accuracy,
        rig: JointLocalizer,
    ) -> Localized:
        """Localize images that were read, given their names in the pairs of images and their poses in the rig."""
        count = POSES_OF_A_VIEW if len(queries) > 1 else POSES_OF_AN_IMAGE
        views: list[list[Look]] = []
        of_prior: list[Look] = []
        for path, query, pose in zip(paths, queries, cam_from_rig, strict=True):
            keypoints = self._extract(query)
            found = self._match(path, keypoints, query)
            views.append([Look.of(keypoints.pixels, one, query.camera, pose, query.focal) for one in found])
            if near is not None:
                max_ratio = self._localizer.config.max_ratio if self._localizer.kind.in_bytes else None
                allowed = near.allows(self.landmarks.points, self.landmarks.mapping_distance_m, query.camera)
                matches = matches_among(found[0], allowed, max_ratio, self._localizer.twins)
                of_prior.append(Look.of(keypoints.pixels, matches, query.camera, pose, query.focal))
        ratio = rig.focal_ratio([first for first, *_ in views])
        views = [[look.scaled(ratio) for look in of_image] for of_image in views]
        poses = [sum((rig.single_view_poses(look, count) for look in of_image), ()) for of_image in views]
        for n, look in enumerate(of_prior):
            poses[n] += rig.single_view_poses(look.scaled(ratio), 1)
        joint = rig.localize([first for first, *_ in views], poses)
        return Localized.of(queries, joint, joint.probabilities(limits), self.frame, self.features_from)

    def _extract(self, query: QueryImage) -> Keypoints:
        """Extract the keypoints of an image, or of it turned upright, at the pixels of the image."""
        turns = query.quarters if query.is_turned else 0
        keypoints = self._localizer.extractor.extract(np.ascontiguousarray(np.rot90(query.rgb, turns)))
        height, width = query.rgb.shape[:2]
        x, y = keypoints.pixels.T
        x, y = ((x, y), (width - y, x), (width - x, height - y), (y, height - x))[turns]
        return replace(keypoints, pixels=np.column_stack([x, y]))

    def _match(self, name: str, keypoints: Keypoints, query: QueryImage) -> list[Matches]:
        """Match an image with all landmarks, or with those of its pairs; by LightGlue, and then also by descriptors.

        The images that LightGlue matches lead to few rival poses; those by descriptors add the others.
        """
        if self.pairs is None:
            found = self._localizer.match_descriptors([keypoints])
        else:
            found = [self._localizer.match_among(keypoints, self.pairs.landmarks(name))]
        return [*self._localizer.by_lightglue([keypoints], found, query.camera), *(found if self.lightglue else [])]

    def _usable(self, cam_from_rig: Float) -> Float:
        """Return poses in a rig with positions only if the map's unit is known. Raises ConfigError if they are needed."""
        if self.frame.scale.is_metric:
            return cam_from_rig
        moved = float(np.linalg.norm(cam_from_rig[:, :, 3] - cam_from_rig[0, :, 3], axis=1).max())
        if moved > 0.1:  # a camera that turns in place moves less
            problem = "the camera moved between the images, and the unit of the map is unknown"
            raise ConfigError(problem, value=f"{moved:.2g} m", fix="Give --scale.")
        return cam_from_rig * (1, 1, 1, 0)
