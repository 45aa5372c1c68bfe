"""The scale of a map: closed forms, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wheretolook.mapping.config import KnownDistance, ScaleConfig
from wheretolook.mapping.markers import Marker
from wheretolook.mapping.scale import (
    MapScale,
    fit_similarity,
    read_marker_table,
    read_positions,
    scale_from_distance,
    scale_from_markers,
    scale_from_positions,
)
from wheretolook.utils.errors import ConfigError, MapError

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)


def square(marker_id: int, side: float) -> Marker:
    return Marker(marker_id, SQUARE * side + marker_id, ("a.jpg", "b.jpg"), 0.1)


def test_similarity_is_recovered_exactly() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10, 3))
    rotation = Rotation.random(random_state=1).as_matrix()
    similarity = fit_similarity(points, 3.7 * points @ rotation.T + (1, -2, 5))
    assert similarity.scale == pytest.approx(3.7)
    np.testing.assert_allclose(similarity.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(similarity.translation, (1, -2, 5), atol=1e-12)


def test_similarity_never_mirrors() -> None:
    points = np.random.default_rng(2).normal(size=(10, 3))
    assert np.linalg.det(fit_similarity(points, points * (1, 1, -1)).rotation) == pytest.approx(1)


def test_similarity_of_too_little_is_refused() -> None:
    with pytest.raises(MapError, match="three points"):
        fit_similarity(np.eye(3)[:2], np.eye(3)[:2])
    line = np.arange(5.0)[:, None] * (1, 2, 3)
    with pytest.raises(MapError, match="on one line"):
        fit_similarity(line, 2 * line)


def test_scale_is_the_median_over_sides() -> None:
    scale = scale_from_markers([square(1, 0.5), square(2, 0.51), square(3, 0.49)], 0.2)
    assert scale.source == "markers" and scale.is_metric
    assert scale.factor == pytest.approx(0.4)
    assert scale.residuals["marker 2 side 0"] == pytest.approx(2.0)
    assert len(scale.residuals) == 12 and scale.unit == "percent"
    assert "off by" in scale.describe()


def test_markers_of_different_sizes_need_a_table() -> None:
    markers = [square(1, 0.5), square(2, 0.5), square(3, 1.0)]
    with pytest.raises(MapError, match=r"do not agree.*marker 3: \+100"):
        scale_from_markers(markers, 0.2)
    assert scale_from_markers(markers, {1: 0.2, 2: 0.2, 3: 0.4}).factor == pytest.approx(0.4)


def test_a_marker_that_is_no_square_is_refused() -> None:
    stretched = Marker(4, SQUARE * (1.0, 1.2, 1.0), ("a.jpg", "b.jpg"), 0.1)
    with pytest.raises(MapError, match="marker 4"):
        scale_from_markers([stretched], 1.0)


def test_no_usable_marker_says_why() -> None:
    with pytest.raises(MapError, match=r"marker 7 is seen in one.*: a\.jpg"):
        scale_from_markers([], 0.2, unused={"marker 7": "marker 7 is seen in one photograph only: a.jpg"})
    with pytest.raises(MapError, match="no marker of a known size was found"):
        scale_from_markers([], 0.2)


def test_scale_from_a_distance() -> None:
    scale = scale_from_distance((0, 0, 0), (0, 3, 4), 2.5)
    assert scale == MapScale("distance", 0.5)
    with pytest.raises(MapError, match="same place"):
        scale_from_distance((1, 1, 1), (1, 1, 1), 2.5)


def test_positions_fix_the_frame_and_leave_residuals() -> None:
    centers = {f"{index}.jpg": center for index, center in enumerate(np.random.default_rng(3).normal(size=(6, 3)))}
    rotation = Rotation.random(random_state=4).as_matrix()
    positions = {name: 2 * rotation @ center + (5, 0, 1) for name, center in centers.items()}
    scale, similarity = scale_from_positions(centers, {**positions, "lost.jpg": np.zeros(3)})
    assert scale.factor == pytest.approx(2)
    assert max(scale.residuals.values()) < 1e-12 and set(scale.residuals) == set(centers)
    assert scale.unused == {"lost.jpg": "not in the map"}
    np.testing.assert_allclose(similarity.apply(centers["3.jpg"]), positions["3.jpg"])
    positions["2.jpg"] = positions["2.jpg"] + (0, 0, 0.3)
    worst = scale_from_positions(centers, positions)[0].residuals
    assert max(worst, key=lambda name: worst[name]) == "2.jpg"


@pytest.mark.parametrize("off_m", [2.0, 100.0])
def test_a_position_that_is_far_off_is_refused_by_name(off_m: float) -> None:
    centers = {f"{index}.jpg": center for index, center in enumerate(np.random.default_rng(3).normal(size=(14, 3)))}
    positions = {name: 2 * center for name, center in centers.items()}
    positions["2.jpg"] = positions["2.jpg"] + (0, off_m, 0)
    with pytest.raises(MapError, match=r"do not agree with the map.* 5 % of .*got '2\.jpg: "):
        scale_from_positions(centers, positions)
    assert scale_from_positions(centers, positions, 95.0)[0].residuals["2.jpg"] > off_m / 2


def test_positions_in_another_order_are_refused() -> None:
    centers = {f"{index}.jpg": center for index, center in enumerate(np.random.default_rng(3).normal(size=(8, 3)))}
    swapped = dict(zip(centers, reversed(centers.values()), strict=True))
    with pytest.raises(MapError, match="do not agree with the map"):
        scale_from_positions(centers, swapped)


def test_the_report_tells_how_well_markers_are_placed() -> None:
    often = Marker(2, SQUARE, ("a.jpg", "b.jpg", "c.jpg"), 0.3)
    scale = scale_from_markers([square(1, 1.0), often], 0.2)
    assert scale.marker_error_px == {"marker 1": 0.1, "marker 2": 0.3}
    assert scale.marker_views == {"marker 1": 2, "marker 2": 3}
    assert "corners missed by 0.3 px at most" in scale.describe() and "NOT CHECKED" not in scale.describe()
    assert "NOT CHECKED: no marker is seen in more" in scale_from_markers([square(1, 1.0)], 0.2).describe()


def test_tables_are_read_and_contradictions_refused(tmp_path: Path) -> None:
    table = tmp_path / "markers.csv"
    table.write_text("id, size_m\n3, 0.4\n7, 0.2\n7, 0.2\n")
    assert read_marker_table(table) == {3: 0.4, 7: 0.2}
    table.write_text("id,size_m\n3,0.4\n3,0.2\n")
    with pytest.raises(ConfigError, match="marker 3 has two sizes"):
        read_marker_table(table)
    for text in ("id,width\n3,0.4\n", "id,size_m\n", "id,size_m\nx,0.4\n", "id,size_m\n3,-1\n", "id,size_m\n3\n"):
        table.write_text(text)
        with pytest.raises(ConfigError, match=r"markers\.csv"):
            read_marker_table(table)


def test_positions_are_read_from_csv_and_json(tmp_path: Path) -> None:
    csv = tmp_path / "positions.csv"
    json = tmp_path / "positions.json"
    csv.write_text("image,x,y,z\na.jpg,1,2,3\n")
    json.write_text('{"a.jpg": [1, 2, 3]}')
    for path in (csv, json):
        np.testing.assert_array_equal(read_positions(path)["a.jpg"], (1, 2, 3))
    csv.write_text("image,x,y,z\na.jpg,1,2,3\na.jpg,1,2,4\n")
    with pytest.raises(ConfigError, match="two positions"):
        read_positions(csv)
    for text in ('{"a.jpg": [1, 2]}', '{"a.jpg": "x"}', "[1]", "{"):
        json.write_text(text)
        with pytest.raises(ConfigError, match=r"positions\.json"):
            read_positions(json)
    with pytest.raises(ConfigError, match=r"missing\.csv"):
        read_positions(tmp_path / "missing.csv")


def test_one_source_of_scale() -> None:
    distance = KnownDistance("a.jpg", "marker:7", 1.5)
    assert distance.marker_ids == (7,)
    for settings in (
        {"marker_size_m": 0.2, "marker_table": Path("markers.csv")},
        {"marker_size_m": 0.2, "distance": distance},
        {"positions": Path("positions.csv"), "distance": distance},
        {"marker_size_m": -1.0},
    ):
        with pytest.raises(ConfigError):
            ScaleConfig(**settings)  # type: ignore[arg-type]
    with pytest.raises(ConfigError):
        KnownDistance("a.jpg", "a.jpg", 1.0)
