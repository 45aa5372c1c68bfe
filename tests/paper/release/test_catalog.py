"""Every figure and table of the catalog, from a store to files, and what is said of those that cannot be made."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from paper.release.synthetic_release import history, make_release
from synthetic_scores import make_scores
from wheretolook.cli import main
from wheretolook.dataset.config import ALL
from wheretolook.dataset.layout import Dataset
from wheretolook.planning.config import PathConfig, PlanConfig
from wheretolook.tracking import TrackingConfig, newest_artifact, newest_run
from wheretolook_paper.figures.scores import ROWS, top_n_figure, top_n_table
from wheretolook_paper.release.catalog import ITEMS, write_items
from wheretolook_paper.release.runs import log_release
from wheretolook_paper.release.showcase import open_showcase, planned_views
from wheretolook_paper.styles import method_style

RELEASE = Path(__file__).parents[3] / "data" / "release"
OF_SCENES = {"pipeline", "learning", "viewpoint_generation", "planning", "planning_photographs", "inputs", "peaks"}
"""Items that need a scene generated from a seed, or results on photographs, which the tiny release lacks."""

NOT_THERE = {"training", "visibility_scaling"} | OF_SCENES


def quiet(text):
    pass


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("catalog")
    release = make_release(folder / "data" / "release")
    tracking = TrackingConfig(str(folder / "mlruns"))
    log_release(release, tracking)
    return release, tracking


@pytest.mark.slow
def test_all_that_has_a_run_is_written_and_attached(store, tmp_path):
    release, tracking = store
    said = []
    missing = write_items(release, tracking, tmp_path, kinds=("pdf",), say=said.append)
    assert missing.keys() == NOT_THERE
    assert missing["training"] == "wheretolook train --config configs/release.yaml"
    assert any(missing["training"] in line for line in said)
    written = {path.stem for path in tmp_path.iterdir()}
    assert written == {item.name for item in ITEMS} - NOT_THERE
    run = newest_run(tracking, "evaluate", params={"dataset": "release"})
    others = newest_run(tracking, "evaluate", params={"dataset": "interiors"})
    assert run is not None and others is not None
    for name, shown in (("top_n", run), ("regret_interiors", others)):
        assert f"runs: {shown.info.run_id}".encode() in (tmp_path / f"{name}.pdf").read_bytes()
    assert run.info.run_id in (tmp_path / "table_vs_others.md").read_text()
    assert (tmp_path / "table_vs_others.tex").read_text().endswith(f"% runs: {run.info.run_id} (evaluate)\n")
    attached = newest_artifact(tracking, "evaluate", "figures/top_n.pdf", "release")
    assert attached.read_bytes() == (tmp_path / "top_n.pdf").read_bytes()
    assert "fully connected 4500 × 300" in (tmp_path / "architecture.md").read_text()


@pytest.mark.slow
def test_scenes_of_the_release_are_drawn_with_the_runs_of_their_weights(tmp_path):
    release = Dataset.load(RELEASE)
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    runs = log_release(release, tracking).ids
    drawn = tuple(OF_SCENES - {"planning"})
    assert write_items(release, tracking, tmp_path / "out", drawn, say=quiet) == {}
    notes = {name: Image.open(tmp_path / "out" / f"{name}.png").info.get("Description", "") for name in drawn}
    assert notes == {
        "pipeline": f"runs: {runs['train set']} (train)", "peaks": f"runs: {runs['train set']} (train)",
        "learning": f"runs: {runs['train mlp-2d+z']} (train)", "inputs": f"runs: {runs['train mlp-2d+z']} (train)",
        "viewpoint_generation": "", "planning_photographs": "",
    }  # fmt: skip
    config = PlanConfig(grid=(4, 4, 2), directions=40, planner=PathConfig(time_s=4.0))
    views = planned_views(open_showcase(release), release, ("forward", "bins"), config)
    ends = [path.positions[[0, -1]] for path in views.values()]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
    assert np.linalg.norm(np.diff(ends[0], axis=0)) > 4  # the farthest of ten pairs


@pytest.mark.slow
def test_the_command_says_what_is_missing(store, tmp_path, capsys):
    """A release whose runs nobody has logged; exit code 2 until the last one is there."""
    shutil.copytree(store[0].root.parent, tmp_path / "data")
    config = tmp_path / "release.yaml"
    config.write_text(f"name: release\ndata: {tmp_path / 'data'}\ntracking: {{folder: {tmp_path / 'mlruns'}}}\n")
    command = ["figures", "--config", str(config), "--out", str(tmp_path / "out"), "--kinds", "[png]", "--only"]
    assert main([*command, "[top_n, training]"]) == 2
    assert "training" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["top_n.png"]
    history().assign(method="mlp-2d+3d").to_csv(tmp_path / "data" / "release" / "results" / "training.csv", index=False)
    assert main([*command, "[top_n, training]"]) == 0
    assert (tmp_path / "out" / "training.png").is_file()
    (tmp_path / "data" / "release" / "release.json").unlink()
    assert main(["log-release", "--config", str(config)]) == 2


def test_marks_of_several_viewpoints_are_the_tables():
    scores = make_scores()
    panels = [axes for axes in top_n_figure(scores).axes if axes.lines]
    assert len(panels) == 8 and [panels[0].get_ylabel(), panels[4].get_ylabel()] == list(ROWS.values())
    pooled = scores[scores["scene"] == ALL]
    for panel, column in ((panels[0], "normalized_0.05m_0.4deg"), (panels[7], "any_5m_10deg")):
        lines = {line.get_label(): line.get_ydata() for line in panel.lines}
        for method in ("bins", "mlp-2d"):
            assert lines[method_style(method).label] == pytest.approx(100 * pooled[pooled["method"] == method][column])
    assert (top_n_table(scores).loc["oracle", "good ones, % of the oracle's"] == 100).all()
