"""Fit the bundled model of the accuracy of views on maps of photographs, by photographs that are held out.

    wheretolook scenes --config kinds.yaml                                    (seeds that the network has not seen)
    python -m wheretolook_paper.studies.fit_photographs walks --meshes data/kinds --out walks
    wheretolook map --images walks/NAME --name NAME --scene NAME              (each; and photographs of real places)
    python -m wheretolook_paper.studies.fit_photographs fit --names '[NAME, ...]' --real '[kitchen, fox, ...]'
    python -m wheretolook_paper.studies.fit_photographs localize --names '[kitchen, fox, ...]' --out localized.csv

`walks` renders walks through scenes in changing light by six cameras, from narrow ones with many pixels to wide ones,
and one that turns nearly on the spot. Mapped without their poses, they have the drift and the noise of photographs.
`fit` holds blocks of each map out as `wheretolook check` does, and prints, for each map fitted by those of other scenes,
what is predicted and observed within 1 and 5 % of the depth (0.4 and 2 degrees), and the model. `localize` localizes
the same photographs by several hypotheses, and compares the confidence in their poses with their errors.
"""

from __future__ import annotations

import json
import zlib
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss

from wheretolook.commands.check import WORK, folder_of_check
from wheretolook.dataset.config import ACCURACY
from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.features.extractor import Keypoints
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, pose_error, poses_looking_along
from wheretolook.holdout.holdout import MIN_LANDMARKS, choose_blocks, hold_out_blocks, judged, without
from wheretolook.holdout.photo_map import open_map
from wheretolook.holdout.scores import Scoring, maps_without
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.mapping.map import find_features
from wheretolook.mapping.rendered_map import plan_walk
from wheretolook.rendering.appearance import Appearance
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.scorers.base import finite_log_odds
from wheretolook.scorers.set.accuracy import MARGIN, STATISTICS, LogError, PhotographModel, statistics_of
from wheretolook.scorers.set.network import MAPPED_DEVIATIONS
from wheretolook.scorers.set.score import SetScorer
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.files import write_text
from wheretolook.visibility.hidden_points import HiddenPointRemoval

# width, height, field of view in degrees, images, share of the floor that is visited, unevenness of their distances
CAMERAS = {
    "walk": (800, 600, 70, 50, 0.6, 1.0),
    "turn": (640, 480, 60, 44, 0.2, 0.3),
    "narrow": (1280, 960, 36, 50, 0.5, 0.3),
    "wide": (640, 480, 95, 40, 0.9, 1.0),
    "short": (960, 720, 65, 24, 0.2, 0.3),
    "video": (640, 360, 75, 60, 0.3, 0.3),
}
TESTED: tuple[tuple[float, float], ...] = (ACCURACY, (0.25, 2.0))
CONFIDENCE_AT: tuple[tuple[float, float], ...] = ((0.01, 0.1), (0.02, 0.2), *TESTED)
FACTORS = (1.0, 1.2, 1.4, 1.5, 1.6, 1.7, 1.8, 2.0, 2.3)  # on the errors of poses
REAL = 16.0  # weight of a place of real photographs, over that of a rendered walk: there are six and 65 of them


def walks(meshes: Path, out: Path, device: str = "cpu") -> None:
    """Render a walk of each camera through each scene of a folder."""
    for path in sorted(meshes.glob("*/mesh.glb")):
        mesh = load_mesh(path)
        space = FreeSpace(mesh)
        renderer = WarpRenderer(mesh, device=device)
        for kind, (width, height, fov_deg, n, coverage, unevenness) in CAMERAS.items():
            name = f"{path.parent.name}_{kind}"
            seed = zlib.crc32(name.replace("_", "").encode()) % 10_000
            camera = PinholeCamera(width, height, width / 2 / np.tan(np.radians(fov_deg) / 2))
            walk = plan_walk(space, mesh.bounds, n, seed, coverage, unevenness)
            positions, axes = walk.positions, walk.directions
            if kind == "turn":
                positions, axes = _turn(positions[n // 2], n, np.random.default_rng(seed))
            poses = poses_looking_along(positions, axes)
            (out / name).mkdir(parents=True)
            for number, (pose, drawn) in enumerate(zip(poses, Appearance.of_views(poses, 0.4, seed), strict=True)):
                image = renderer.render(camera, pose[None])
                rgb = drawn.apply(image.rgb[0], camera, image.depth_m[0])
                cv2.imwrite(str(out / name / f"{number:04}.jpg"), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])


def _turn(center: Float, n: int, rng: np.random.Generator) -> tuple[Float, Float]:
    """Return positions and axes (n, 3) of a camera that is held at arm's length and turns once."""
    angle = np.linspace(0, 2 * np.pi, n)
    circle = 0.25 * np.stack([np.cos(angle), np.sin(angle), 0.2 * np.sin(3 * angle)], 1)
    pitch = np.radians(rng.normal(-5, 6, n))
    yaw = angle + rng.normal(0, 0.05, n)
    axes = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], 1)
    return center + circle + rng.normal(0, 0.02, (n, 3)), axes


def read_views(data: Path, name: str) -> pd.DataFrame:
    """Return errors in units of ACCURACY, network's log-odds and `STATISTICS` of the held-out views of a map."""
    model = data / name / name / "map"
    features = find_features(model)
    assert features is not None
    source = open_map(model, features, name)
    parts = []
    for result in hold_out_blocks(source, folder_of_check(data, f"{name}-{name}") / WORK):
        views = judged(result, ACCURACY).views
        for rows, remaining in maps_without(source, result, HiddenPointRemoval(), "cpu"):
            scorer = Scoring().scorer(remaining, anywhere=True)
            assert isinstance(scorer, SetScorer)
            poses = np.stack([source.view(*pair)[1] for pair in views.iloc[rows][["row", "crop"]].to_numpy().tolist()])
            for block, described, n_visible in scorer.describer.in_blocks(poses, scorer.max_landmarks):
                sums = scorer.network.sums_of(described, n_visible)
                own = scorer.trained.calibrated(scorer.network.logits(sums).double()).sigmoid().numpy()
                found = pd.DataFrame(statistics_of(scorer.trained, sums), columns=STATISTICS)
                of_block = views.iloc[rows[block]]
                limit_m = of_block["limit_m"].to_numpy()
                found["log_mapped_position_deviation"] -= np.log(limit_m / ACCURACY[0])
                right = of_block["status"].to_numpy() == "localized"
                found["error_m"] = np.where(right, of_block["error_m"] / limit_m * ACCURACY[0], np.inf)
                found["error_deg"] = np.where(right, of_block["error_deg"], np.inf)
                found["place"] = of_block["right_place"].to_numpy(bool)
                parts.append(found.assign(log_odds=finite_log_odds(own, MARGIN), map=name))
    return pd.concat(parts, ignore_index=True)


def fit(views: pd.DataFrame, real: tuple[str, ...]) -> PhotographModel:
    """Fit both factors: each rendered walk has the same weight, and each real place `REAL` times that."""
    is_real = views["map"].isin(real)
    together = views["map"].str.split("_").str[0].where(is_real, views["map"])
    sizes = views.groupby(together)["place"].transform("size").to_numpy(np.float64)
    weight = np.where(is_real, REAL, 1.0) / sizes
    weight /= weight.mean()
    place = views["place"].to_numpy(bool)
    features = views[list(PhotographModel.names)].to_numpy()
    logistic = LogisticRegression(C=1e3, max_iter=3000).fit(features, place, weight)
    errors = []
    for column, deviation, least in zip(("error_m", "error_deg"), MAPPED_DEVIATIONS, (5e-6, 1e-4), strict=True):
        logs = np.log(views[column].clip(lower=least)) - views[deviation]
        mean = np.average(logs[place], weights=weight[place])
        spread = np.sqrt(np.average((logs[place] - mean) ** 2, weights=weight[place]))
        errors.append(LogError((), round(float(mean), 4), round(float(spread), 4)))
    bias = round(float(logistic.intercept_[0]), 4)
    return PhotographModel(tuple(logistic.coef_[0].round(4).tolist()), bias, tuple(errors))


def fit_maps(names: list[str], real: list[str], data: Path = Path("data")) -> None:
    """Compare predictions by maps of other scenes with what is observed, and print the model of all.

    Args:
        names: datasets of a map each; of maps of one scene the names start alike, up to a "_".
        real: those of them that are of real photographs.
        data: folder of the datasets.
    """
    views = pd.concat([read_views(data, name) for name in names], ignore_index=True)
    scene = views["map"].str.split("_").str[0]
    known = tuple(real)
    rows = []
    for name in names:
        of_map = views[views["map"] == name]
        model = fit(views[scene != name.split("_")[0]], known)
        row: dict[str, object] = {"map": name, "views": len(of_map)}
        for accuracy in TESTED:
            good = ((of_map["error_m"] < accuracy[0]) & (of_map["error_deg"] < accuracy[1])).to_numpy()
            own = 1 / (1 + np.exp(-of_map["log_odds"].to_numpy()))
            predicted = model.at(accuracy, ACCURACY, own, of_map[list(STATISTICS)].to_numpy())
            error = expected_calibration_error(predicted, good)
            loss = log_loss(good, predicted.clip(1e-4, 1 - 1e-4), labels=[False, True])
            row |= {f"{key} {accuracy[0]}": value for key, value in
                    (("predicted", predicted.mean()), ("observed", good.mean()), ("error", error), ("loss", loss))}  # fmt: skip
        rows.append(row)
    print(pd.DataFrame(rows).round(3).to_string(index=False))
    whole = fit(views, known)
    record = {"weights": dict(zip(PhotographModel.names, whole.weights, strict=True)), "bias": whole.bias}
    errors = {
        name: {**vars(error), "weights": {}}
        for name, error in zip(("position", "orientation"), whole.errors, strict=True)
    }
    print(json.dumps(record | {"errors": errors}, indent=2))


def localized(data: Path, name: str) -> pd.DataFrame:
    """Localize the held-out photographs of a map by several hypotheses.

    Returns for each its errors, in units of ACCURACY, and at each of `CONFIDENCE_AT` the probabilities of its pose for
    each of `FACTORS` (columns (accuracy, factor)).
    """
    model = data / name / name / "map"
    features = find_features(model)
    assert features is not None
    source = open_map(model, features, name)
    rows = []
    for block in choose_blocks(source):
        rest = without(source.model, source.arrays.image_ids[block.held_out].tolist())
        if rest.num_points3D() < MIN_LANDMARKS:
            continue
        landmarks = load_colmap_landmarks(model, features, None, "cpu", rest, progress=False)
        kind, stored = read_features(features, [source.names[row] for row in block.tested])
        config = LocalizerConfig(method="hypotheses")
        localizer = Localizer(landmarks, source.cameras[int(block.tested[0])], config, photographs=True)
        for row, (pixels, descriptors) in zip(block.tested.tolist(), stored, strict=True):
            camera, pose = source.view(row, 0)
            keypoints = Keypoints(pixels, kind.restore(descriptors))
            look = Look.of(pixels, localizer.match([keypoints])[0], camera)
            found = localizer.joint.localize([look])
            unit = float(source.limit_m[row]) / ACCURACY[0]
            record: dict[object, object] = {"map": name, "error_m": np.inf, "error_deg": np.inf}
            if found.rig_from_world is not None:
                error_m, error_deg = pose_error(found.rig_from_world, pose)
                record |= {"error_m": float(error_m) / unit, "error_deg": float(error_deg)}
            for at, factor in product(CONFIDENCE_AT, FACTORS):
                # with other errors, as at another accuracy
                scale = found.error_factor / factor
                record[at, factor] = found.probability((at[0] * unit * scale, at[1] * scale))
            rows.append(record)
    return pd.DataFrame(rows)


def localize_maps(names: list[str], out: Path, data: Path = Path("data")) -> None:
    """Compare the confidence in poses of held-out photographs with their errors, and write a row for each map and accuracy.

    The factor on the errors that `confidence.ERRORS_ON_PHOTOGRAPHS` states is that with the least log loss, chosen here
    for each place by the others.

    Args:
        names: datasets of a map of photographs each; of maps of one place the names start alike, up to a "_".
        out: CSV file.
        data: folder of the datasets.
    """
    poses = pd.concat([localized(data, name) for name in names], ignore_index=True)
    place = poses["map"].str.split("_").str[0]
    weight = 1 / poses["map"].map(poses["map"].value_counts()) / place.map(poses.groupby(place)["map"].nunique())
    good = {at: ((poses["error_m"] < at[0]) & (poses["error_deg"] < at[1])).to_numpy() for at in CONFIDENCE_AT}

    def loss(factor: float, rows: NDArray[np.bool_]) -> float:
        """Return the mean log loss over accuracies."""
        losses = [
            log_loss(
                good[at][rows],
                poses.loc[rows, [(at, factor)]].clip(1e-4, 1 - 1e-4),
                sample_weight=weight[rows],
                labels=[False, True],
            )
            for at in CONFIDENCE_AT
        ]
        return float(np.mean(losses))

    records = []
    for name in names:
        of_map = (poses["map"] == name).to_numpy()
        others = (place != name.split("_")[0]).to_numpy()
        chosen = min(FACTORS, key=lambda factor: loss(factor, others))
        for at in CONFIDENCE_AT:
            right = good[at][of_map]
            record: dict[str, object] = {"map": name, "accuracy_m": at[0], "poses": len(right), "right": right.mean()}
            record["factor"] = chosen
            for label, factor in (("", chosen), ("_without", 1.0)):
                predicted = poses.loc[of_map, [(at, factor)]].to_numpy()[:, 0]
                sure = predicted >= 0.99
                record[f"predicted{label}"] = predicted.mean()
                record |= {f"sure{label}": sure.sum(), f"sure_right{label}": right[sure].sum()}
                record[f"loss{label}"] = log_loss(right, predicted.clip(1e-4, 1 - 1e-4), labels=[False, True])
            records.append(record)
    everywhere = np.ones(len(poses), dtype=bool)
    print({factor: round(loss(factor, everywhere), 4) for factor in FACTORS})
    table = pd.DataFrame(records).round(4)
    print(table.to_string(index=False))
    write_text(out, table.to_csv(index=False))


if __name__ == "__main__":
    auto_cli({"walks": walks, "fit": fit_maps, "localize": localize_maps}, as_positional=False)
