# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Runtimes
#
# How long does it take to find out which of 24,919 landmarks every one of 500 directions at 648 locations sees? The
# paper's figure of runtimes with this project's times beside it, from the newest benchmark in the tracking store; on a
# fresh clone that of the release is logged first.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
import pandas as pd
from IPython.display import Image, Markdown, display

from wheretolook.tracking.runs import newest_artifact
from wheretolook_paper.release.notebook import open_release, open_store

tracking = open_store(open_release())

# %% [markdown]
# ## Against the paper
#
# The axis is logarithmic: each line is ten times the one before. Hatched bars are the paper's, on its machines; the
# dotted one is the authors' released kernel on an H200. The NumPy twin does the same work in the plainest way, so that
# the gain can be told from the machine's. Below, the whole check with occlusion, which the paper's times leave out.

# %%
from wheretolook_paper.figures.runtimes import runtime_figure

times = pd.read_csv(newest_artifact(tracking, "benchmark", "runtimes.csv"))
display(runtime_figure(times))

# %% [markdown]
# ## In numbers
#
# Median, least and most seconds of repeated runs, and billions of projections a second that the counting stands for.

# %%
from wheretolook_paper.figures.runtimes import runtime_table

runtime_table(times).style.hide().format(precision=3)

# %% [markdown]
# ## On your machine
#
# `python tests/benchmarks/bench_visibility.py --out mine.json` measures (add `--device cuda` for a GPU), and
# `python tests/benchmarks/bench_visibility.py --draw mine.json --log` logs it: this notebook then shows that run.
# With `--scaling` it measures how time and memory grow, too, which is drawn here if the store knows it.

# %%
from wheretolook.utils.errors import MissingRunError
from wheretolook_paper.figures.runtimes import scaling_figure

try:
    display(scaling_figure(pd.read_csv(newest_artifact(tracking, "benchmark", "scaling.csv"))))
except MissingRunError:
    display(
        Markdown("Not measured on this machine; on an H200 and on two cores:"), Image("images/visibility-scaling.webp")
    )
