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
# How long does it take to determine which of 24,919 landmarks are visible in each of 500 directions at 648 locations?
# The paper's runtime figure with this project's times, from the newest benchmark in the tracking store; on a fresh
# clone that of the release is logged first.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
import pandas as pd
from IPython.display import Image, Markdown, display

from wheretolook.tracking import newest_artifact
from wheretolook_paper.release.notebook import open_release, open_store

tracking = open_store(open_release())

# %% [markdown]
# ## Compared with the paper
#
# Logarithmic axis. Hatched bars are the paper's, on its machines; the dotted one is the authors' released kernel on an
# H200. The NumPy twin does the same work plainly, which separates the algorithm's gain from the machine's. Below, the
# complete check with occlusion, which the paper's times exclude.

# %%
from wheretolook_paper.figures.runtimes import runtime_figure

times = pd.read_csv(newest_artifact(tracking, "benchmark", "runtimes.csv"))
display(runtime_figure(times))

# %% [markdown]
# ## Numbers
#
# Median, minimum and maximum seconds of repeated runs, and the equivalent billions of projections per second.

# %%
from wheretolook_paper.figures.runtimes import runtime_table

runtime_table(times).style.hide().format(precision=3)

# %% [markdown]
# ## One inference step
#
# The paper: "one inference step of our model takes around 0.02 seconds with our setup". Here, from landmarks and poses
# to scores, given which landmarks are unoccluded: all directions at one location, and a single pose.

# %%
from wheretolook_paper.figures.runtimes import step_table

step_table(times).style.hide().format(precision=1, thousands=",", na_rep="–")

# %% [markdown]
# ## Your machine
#
# `python tests/benchmarks/bench_visibility.py --out mine.json` measures (add `--device cuda` for a GPU), and `python
# tests/benchmarks/bench_visibility.py --draw mine.json --log` logs the run shown here. `--scaling` also measures the
# growth of time and memory, drawn here if logged. An inference step is measured by `python
# tests/benchmarks/bench_scorers.py --step --out step.json`, which `--draw` takes too.

# %%
from wheretolook.utils.errors import MissingRunError
from wheretolook_paper.figures.runtimes import scaling_figure

try:
    display(scaling_figure(pd.read_csv(newest_artifact(tracking, "benchmark", "scaling.csv"))))
except MissingRunError:
    display(
        Markdown("Not measured on this machine; on an H200 and on two cores:"), Image("images/visibility-scaling.webp")
    )
