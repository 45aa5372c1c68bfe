"""Figures of runtimes, growth and occlusion models show the numbers they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread

from wheretolook.figures.style import save_figure
from wheretolook.scorers.styles import method_style
from wheretolook_paper.figures.occlusion import occlusion_figure
from wheretolook_paper.figures.runtimes import duration, machine_label, runtime_figure, scaling_figure

COUNTS = "counts alone"
EVERYTHING = "occlusion, counts, best 100"
TWIN = "NumPy twin, counts alone, scaled"
CPU = {"device": "cpu", "name": "Intel(R) Xeon(R) Gold 6430 CPU @ 2.10GHz", "cores": 2}
GPU = {"device": "cuda:0", "name": "NVIDIA H200", "cores": 16}
PAPER = {"paper, CPU, 1 thread": 7387.0, "paper, GPU": 23.0, "released kernel, H200": 12.2}


def _size(machine: dict, what: str, threads: int, seconds: float, repeats: int = 20) -> dict:  # type: ignore[type-arg]
    ends = {"min_s": 0.9 * seconds, "max_s": 1.2 * seconds}
    return {**machine, "what": what, "threads": threads, "median_s": seconds, **ends, "repeats": repeats}


@pytest.fixture
def sizes() -> pd.DataFrame:
    return pd.DataFrame(
        [
            _size(GPU, EVERYTHING, 1, 0.0115), _size(GPU, COUNTS, 1, 0.00358), _size(GPU, "occlusion alone", 1, 0.006),
            _size(GPU, "cells of the sphere (once)", 1, 0.004), _size(GPU, TWIN, 1, 149.2, 1),
            {**GPU, "what": "peak", "threads": 1, "flops": 5e13},
            _size(CPU, EVERYTHING, 2, 7.5), _size(CPU, EVERYTHING, 1, 14.0), _size(CPU, COUNTS, 2, 3.5),
            _size(CPU, COUNTS, 1, 6.5), _size(CPU, TWIN, 1, 151.0, 5),
        ]
    )  # fmt: skip


def _bars(axes: Axes) -> dict[str, float]:
    """Where each bar ends, by its label."""
    labels = [label.get_text() for label in axes.get_yticklabels()]
    return dict(zip(labels, (patch.get_x() + patch.get_width() for patch in axes.patches), strict=True))  # type: ignore[attr-defined]


def test_runtime_figure_draws_the_rows_beside_the_papers(sizes: pd.DataFrame, tmp_path: Path) -> None:
    figure = runtime_figure(sizes)
    counts, everything = figure.axes
    xeon = "Intel Xeon Gold 6430"
    expected = {f"{xeon}, 1 thread": 6.5, f"{xeon}, all 2 cores": 3.5, "NVIDIA H200": 0.00358}
    expected = PAPER | {"NumPy, 1 thread, scaled up": 151.0} | expected
    assert _bars(counts) == pytest.approx({_wrapped(label): value for label, value in expected.items()})
    assert list(_bars(everything).values()) == pytest.approx([14.0, 7.5, 0.0115])
    assert [text.get_text() for text in counts.texts] == [
        "7,387 s", "23 s", "12.2 s", "151 s", "6.50 s", "3.50 s", "3.58 ms",
    ]  # fmt: skip
    assert counts.get_xscale() == "log"
    assert counts.get_xlim() == everything.get_xlim()
    assert counts.get_xlim()[0] <= 1e-3
    _assert_draws(figure, tmp_path)


def test_runtime_figure_tells_whose_numbers_they_are(sizes: pd.DataFrame) -> None:
    figure = runtime_figure(sizes)
    hatches = [patch.get_hatch() for patch in figure.axes[0].patches]
    assert hatches[0] == hatches[1]
    assert len({*hatches[:3], None}) == 3
    assert hatches[3:] == [None] * 4
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["from the paper", "authors' kernel, measured", "this project, measured"]


def test_runtime_figure_has_whiskers_where_runs_were_repeated(sizes: pd.DataFrame) -> None:
    ends = _whiskers(runtime_figure(sizes).axes[0])
    np.testing.assert_allclose(ends, [[0.9 * s, 1.2 * s] for s in (151.0, 6.5, 3.5, 0.00358)])
    sizes["repeats"] = 1
    assert len(_whiskers(runtime_figure(sizes).axes[0])) == 0


def _whiskers(axes: Axes) -> np.ndarray:
    segments = [segment[:, 0] for collection in axes.collections for segment in collection.get_segments()]  # type: ignore[attr-defined]
    return np.array(segments)


def test_runtime_figure_of_one_machine_or_none(sizes: pd.DataFrame, tmp_path: Path) -> None:
    gpu = runtime_figure(sizes[sizes["device"] != "cpu"])
    assert list(_bars(gpu.axes[0]).values()) == pytest.approx([*PAPER.values(), 149.2, 0.00358])
    cpu = runtime_figure(sizes[sizes["device"] == "cpu"])
    assert list(_bars(cpu.axes[1]).values()) == pytest.approx([14.0, 7.5])
    none = runtime_figure(pd.DataFrame())
    assert _bars(none.axes[0]) == pytest.approx(PAPER)
    assert len(none.axes) == 1
    _assert_draws(none, tmp_path)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0035811, "3.58 ms"), (0.0115, "11.5 ms"), (0.9999, "1.00 s"), (6.5, "6.50 s"), (99.97, "100 s"),
     (7387.0, "7,390 s"), (0.000123, "0.123 ms")],
)  # fmt: skip
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("name", "label"),
    [("Intel(R) Xeon(R) Processor @ 2.80GHz", "Intel Xeon"),
     ("AMD Ryzen 9 7950X 16-Core Processor", "AMD Ryzen 9 7950X"), ("x86_64", "CPU"), ("NVIDIA H200", "NVIDIA H200")],
)  # fmt: skip
def test_names_of_machines(name: str, label: str) -> None:
    assert machine_label(name) == label


@pytest.fixture
def growth() -> pd.DataFrame:
    rows = []
    for machine, speed in ((CPU, 1e-8), (GPU, 1e-11)):
        for axis, values in {"landmarks": (1000, 10, 100), "locations": (8, 512), "directions": (50, 5000)}.items():
            for value in values:
                size = {"landmarks": 24_919, "locations": 64, "directions": 500, axis: value}
                seconds = speed * np.prod(list(size.values()))
                for what, factor in (("with occlusion", 2.0), (COUNTS, 1.0)):
                    row = _size(machine, what, 1, factor * seconds)
                    rows.append({**row, "axis": axis, **size, "peak_bytes": 1000 * value if value != 10 else 0})
    return pd.DataFrame(rows)


def test_scaling_figure_draws_time_and_memory(growth: pd.DataFrame, tmp_path: Path) -> None:
    figure = scaling_figure(growth)
    assert len(figure.axes) == 6
    assert [axes.get_title() for axes in figure.axes[:3]] == [
        "64 locations\n500 directions", "24,919 landmarks\n500 directions", "24,919 landmarks\n64 locations",
    ]  # fmt: skip
    assert [axes.get_xlabel() for axes in figure.axes[3:]] == ["landmarks", "locations", "directions"]
    assert figure.axes[0].get_ylabel() == "time (s)"
    assert figure.axes[3].get_ylabel() == "peak memory (MB)"
    (line,) = (line for line in figure.axes[0].lines if line.get_label() == "NVIDIA H200, with occlusion")
    np.testing.assert_array_equal(line.get_xdata(), [10, 100, 1000])
    np.testing.assert_allclose(line.get_ydata(), [2e-11 * 64 * 500 * n for n in (10, 100, 1000)])
    memory = [line for line in figure.axes[3].lines if line.get_label() != "proportional"]
    assert len(memory) == 4
    for line in memory:  # nothing was measurable at 10
        np.testing.assert_allclose(line.get_data(), [[100, 1000], [0.1, 1]])
    for top in figure.axes[:3]:
        assert top.get_ylim() == figure.axes[0].get_ylim()
        assert (top.get_xscale(), top.get_yscale()) == ("log", "log")
    _assert_draws(figure, tmp_path)


def test_scaling_lines_can_be_told_apart(growth: pd.DataFrame) -> None:
    figure = scaling_figure(growth)
    lines = [line for line in figure.axes[0].lines if not str(line.get_label()).startswith("_")]
    looks = {(line.get_marker(), line.get_markerfacecolor() == "white", line.get_linestyle()) for line in lines}
    assert len(looks) == len(lines) == 5
    (proportional,) = (line for line in lines if line.get_label() == "proportional")
    x, y = np.log(np.asarray(proportional.get_data()))
    assert np.diff(y) == pytest.approx(np.diff(x))


def test_scaling_figure_of_one_machine(growth: pd.DataFrame, tmp_path: Path) -> None:
    part = growth[(growth["device"] == "cpu") & (growth["axis"] != "directions")].assign(peak_bytes=0)
    figure = scaling_figure(part)
    assert len(figure.axes) == 4
    _assert_draws(figure, tmp_path)


METHODS = ("random", "bins", "mlp-2d", "oracle")


@pytest.fixture
def scores() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = []
    for occlusion in ("mesh", "hidden-points", "none"):
        for scene in ("all", "a", "b"):
            for n in (1, 5):
                for method in METHODS:
                    row = {"method": method, "occlusion": occlusion, "top_n": n, "scene": scene}
                    for key in ("0.05m_0.4deg", "0.25m_2deg"):
                        low, value, high = np.sort(rng.random(3)) if method != "random" else (0.2, 0.3, 0.4)
                        row |= {f"normalized_{key}": value, f"normalized_low_{key}": low}
                        row |= {f"normalized_high_{key}": high, f"any_{key}": value}
                    rows.append({**row, "average_precision": 0.25 if method == "random" else rng.random()})
    return pd.DataFrame(rows)


def test_occlusion_figure_draws_every_method_by_model(scores: pd.DataFrame, tmp_path: Path) -> None:
    figure = occlusion_figure(scores)
    left, right = figure.axes
    first = scores[(scores["scene"] == "all") & (scores["top_n"] == 1)]
    mesh = first[(first["occlusion"] == "mesh") & first["method"].isin(["bins", "mlp-2d"])]
    best_first = list(mesh.sort_values("normalized_0.05m_0.4deg", ascending=False)["method"])
    assert [label.get_text() for label in left.get_yticklabels()] == [method_style(one).label for one in best_first]
    (legend,) = figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["mesh rays", "hidden-point removal", "none: through walls", "random", "oracle"]
    for method in METHODS[1:3]:
        rows = first[first["method"] == method]
        style = method_style(method)
        np.testing.assert_allclose(_line(left, style.label).get_xdata(), rows["average_precision"])
        drawn = _line(right, style.label)
        np.testing.assert_allclose(drawn.get_xdata(), 100 * rows["normalized_0.05m_0.4deg"])
        row = best_first.index(method)
        assert np.abs(np.asarray(drawn.get_ydata()) - row).max() < 0.5 and drawn.get_color() == style.color
    ends = [segment[:, 0] for collection in right.collections for segment in collection.get_segments()]  # type: ignore[attr-defined]
    shown = pd.concat([first[first["method"] == method] for method in best_first])
    columns = ["normalized_low_0.05m_0.4deg", "normalized_high_0.05m_0.4deg"]
    np.testing.assert_allclose(ends, 100 * shown[columns].to_numpy())
    assert set(_line(left, "random").get_xdata()) == {0.25}
    assert set(_line(right, "random").get_xdata()) == {30.0}
    assert "best view within 5 cm, 0.4°" in right.get_xlabel()
    _assert_draws(figure, tmp_path)


def test_occlusion_figure_of_one_model(scores: pd.DataFrame, tmp_path: Path) -> None:
    part = scores[(scores["occlusion"] == "none") & (scores["method"] != "random") & (scores["top_n"] == 5)]
    figure = occlusion_figure(part)
    assert "best 5 views" in figure.axes[1].get_xlabel()
    _assert_draws(figure, tmp_path)


def _line(axes: Axes, label: str):  # type: ignore[no-untyped-def]
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return line


def _wrapped(label: str) -> str:
    return label if len(label) <= 27 else ",\n".join(label.rsplit(", ", 1))


def _assert_draws(figure: Figure, folder: Path) -> None:
    save_figure(figure, folder / "figure.png")
    image = imread(folder / "figure.png")
    assert image.shape[0] > 200
    assert image.std() > 0.01
