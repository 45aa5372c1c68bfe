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
# # Several viewpoints per location
#
# A planner may not be able to take the best view. Is the fifth or tenth still good? The paper's figure "Multiple
# viewpoints results", from the newest evaluation in the tracking store; on a fresh clone that of the release is logged
# first.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import Markdown, display

from wheretolook.evaluation.results import latest_scores
from wheretolook_paper.figures.scores import top_n_figure
from wheretolook_paper.release.notebook import open_release, open_store

release = open_release()
scores = latest_scores(open_store(release), release.name)

# %% [markdown]
# ## Two measures
#
# Above, the fraction of positive views among the best N, in % of the oracle: it hardly changes with N, so the tenth
# best is nearly as good. Below, the fraction of locations with a positive view among N: with ten views even random is
# close to the oracle, because most locations have many positive views. The paper prints numbers for N = 1 only, on
# other scenes: open grey marks.

# %%
display(top_n_figure(scores))

# %% [markdown]
# ## Other methods
#
# The same for methods that weight landmarks by detection probability.

# %%
expected = ["expected-inliers", "expected-bins", "fisher-trace-expected", "set", "random"]
display(top_n_figure(scores, expected))

# %% [markdown]
# ## Numbers
#
# Within 5 cm and 0.4°, in %: positive views among the best N, and locations with a positive view among N.

# %%
from wheretolook_paper.figures.scores import top_n_table

table = top_n_table(scores)
display(table.style.format(precision=1))

# %%
share, found = table["good ones, % of the oracle's"], table["locations with one, %"]["N = 10"]
change = (share["N = 10"] - share["N = 1"]).abs().max()
behind = found["oracle"] - found
display(
    Markdown(
        f"From one view to ten the share changes by at most {change:.1f} points; with ten views random is within "
        f"{behind['random']:.1f} points of the oracle, the other methods within {behind.drop('random').max():.1f}."
    )
)
