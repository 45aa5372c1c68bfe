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
# # Several viewpoints of a location
#
# **Is the fifth or tenth best view of a place still good?** A planner may not be able to take the best one. This is the
# paper's figure "Multiple viewpoints results", from the newest evaluation in the tracking store; on a fresh clone that
# of the release is logged first.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import display

from wheretolook.evaluation.results import latest_scores
from wheretolook_paper.figures.top_n import top_n_figure
from wheretolook_paper.release.notebook import open_release, open_store

release = open_release()
scores = latest_scores(open_store(release), release.name)

# %% [markdown]
# ## Two meanings of a score
#
# Above, how many of the best N views are good, in % of what an oracle reaches: from left to right in a panel it changes
# by a point or two, so a planner may nearly as well take the tenth best. Below, at how many locations one of N is good:
# with ten tries the methods shown are within two points of the oracle's line, since most locations have many good
# views, and random is within five.
# The paper prints numbers for N = 1 alone, on other scenes: open grey marks.

# %%
display(top_n_figure(scores))

# %% [markdown]
# ## Other methods
#
# Any methods of the table can be drawn so: here those that weight landmarks by their chance of being found.

# %%
expected = ["expected-inliers", "expected-bins", "fisher-trace-expected", "set", "random"]
display(top_n_figure(scores, expected))

# %% [markdown]
# ## In numbers
#
# Within 5 cm and 0.4°, in %: the share of good ones among the best N, and of locations with a good one among N.

# %%
from wheretolook_paper.figures.top_n import top_n_table

top_n_table(scores).style.format(precision=1)
