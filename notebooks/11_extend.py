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
# # Which photographs next
#
# A map of 30 images of a walk is extended by ten photographs, of each policy in turn, and target views are localized in
# the result. How they are chosen: docs/extend.md.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
import pandas as pd
from IPython.display import display

from wheretolook_paper.evaluation.extend import EXTEND_CSV, PHOTOGRAPHS_CSV, policies
from wheretolook_paper.figures.extend import extend_figure
from wheretolook_paper.release.notebook import open_release

results = open_release().root / "results"

# %% [markdown]
# ## Rendered scenes
#
# Two test apartments and six interiors by others, three walks in each. Left: gain over the present map with 95 %
# intervals over maps. Middle: predicted and measured share of the target views. Right: how often photographs of the
# plans register, by their predicted probability.

# %%
scenes = pd.read_csv(results / EXTEND_CSV)
display(extend_figure(scenes))

# %%
display(policies(scenes).set_index("policy").round(3))

# %% [markdown]
# ## Photographs
#
# Consecutive photographs are the map, and others of the same set are added. The surface is known from landmarks alone.

# %%
photographs = pd.read_csv(results / PHOTOGRAPHS_CSV)
for name, rows in photographs.groupby("scene"):
    display(policies(rows).set_index("policy").round(3).rename_axis(name))
