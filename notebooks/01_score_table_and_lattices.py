# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Score table and lattices of directions
#
# Reads the newest evaluation from the MLflow store and draws its table and figure, then the lattices of directions that
# viewpoints are sampled from. Nothing is computed here that a stage of the pipeline computes.
#
# The store is the folder named by the environment variable `WHERETOLOOK_MLRUNS`, or else `mlruns` in this folder or in
# the nearest folder above it.

# %%
# %matplotlib inline
import os
from pathlib import Path

from IPython.display import Markdown, display

from wheretolook.evaluation import latest_scores
from wheretolook.evaluation.report import score_markdown
from wheretolook.figures.lattices import fibonacci_figure
from wheretolook.figures.scores import score_figure
from wheretolook.tracking import TrackingConfig, ui_command

here = Path.cwd()
stores = [folder / "mlruns" for folder in (here, *here.parents) if (folder / "mlruns" / "mlflow.db").is_file()]
store = Path(os.environ.get("WHERETOLOOK_MLRUNS") or (stores[0] if stores else here.parent / "mlruns"))
tracking = TrackingConfig(str(store))

# %% [markdown]
# ## Localization score

# %%
scores = latest_scores(tracking)
if scores is None:
    display(Markdown(f"There is no evaluation in `{store}` yet: run `make demo`, or `wheretolook evaluate`."))
else:
    display(Markdown(score_markdown(scores)))
    display(score_figure(scores))
    print("All runs:", ui_command(tracking))

# %% [markdown]
# ## Directions
#
# The paper samples directions with a spherical Fibonacci lattice, but its printed formula is undefined for half of its
# indices, and its released code uses the two angles on the wrong axes: directions crowd at two poles and leave holes.

# %%
display(fibonacci_figure(500))
