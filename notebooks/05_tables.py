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
# # The paper's tables
#
# Both tables of the paper's experiments with intervals and the published numbers; then all methods, their regret, and
# the effect of occlusion. From the newest evaluation in the tracking store; on a fresh clone that of the release is
# logged first.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import Markdown, display

from wheretolook_paper.evaluation.paper_tables import NOTE, latest_paper_table, paper_styler
from wheretolook_paper.release.notebook import open_release, open_store

release = open_release()
tracking = open_store(release)

# %% [markdown]
# ## Table 2: all methods
#
# The best view of each location at four thresholds. *Ours* is the share of views that localize, in % of the oracle,
# with its 95 % interval; */0.527* the same share divided as in the paper's released code. Compare the order of methods
# within a column, not absolute numbers.

# %%
display(Markdown(NOTE))
paper_styler(latest_paper_table(tracking, "vs_others", release.name))

# %% [markdown]
# ## Table 3: input variants
#
# In the paper depth gains four points at the strictest threshold. Here the three variants are within each other's
# intervals.

# %%
paper_styler(latest_paper_table(tracking, "input_variants", release.name))

# %% [markdown]
# ## All methods
#
# The best view of each location at the strictest and the loosest threshold, best method on top; arrows point to methods
# beyond the axis. Methods with landmark attributes lead at the strictest threshold; at the loosest most are alike. The
# best three Fisher information rows are shown; the final table has all.

# %%
from wheretolook.evaluation.results import latest_scores
from wheretolook_paper.figures.scores import regret_figure, score_figure

scores = latest_scores(tracking, release.name)
display(score_figure(scores))

# %% [markdown]
# ## Regret
#
# Left, the distance to the oracle; right, the paired difference to the set network: methods whose whisker crosses the
# dashed line do not differ significantly.

# %%
display(regret_figure(scores))

# %% [markdown]
# Six interiors by other authors, not used for training: differences are larger, and the paper's network is ahead of the
# bins.

# %%
display(regret_figure(latest_scores(tracking, "interiors")))

# %% [markdown]
# ## Without occlusion
#
# Discs with true occlusion, squares as if every method saw through walls, as in the paper's released code. Without
# occlusion bins and networks are above the paper's Fisher information rows, as in the paper, but bins above its
# network. Counting methods and summed information lose most.

# %%
from wheretolook_paper.figures.scores import occlusion_figure

display(occlusion_figure(scores))

# %% [markdown]
# ## All numbers
#
# The complete evaluation, also in `results/scores.md` of the dataset.

# %%
from wheretolook_paper.evaluation.score_report import score_markdown

display(Markdown(score_markdown(scores)))
