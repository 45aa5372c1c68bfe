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
# How well does each method choose where to look, and how sure is that? Both tables of the paper's experiments, with
# intervals, beside the numbers it prints; then all methods at once, what each loses, and what occlusion has to do with
# it. All from the newest evaluation in the tracking store; on a fresh clone that of the release is logged first.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import Markdown, display

from wheretolook_paper.evaluation.paper_tables import NOTE
from wheretolook_paper.release.notebook import open_release, open_store
from wheretolook_paper.release.table_view import latest_paper_table, paper_styler

release = open_release()
tracking = open_store(release)

# %% [markdown]
# ## Table 2: all methods
#
# The best view of each location, at four limits of the error. *Ours* is the share of views that localize, in % of what
# an oracle reaches, with its 95 % interval over locations; */0.527* the same share divided as the paper's released code
# divides. Read down a column: the order of the methods is what can be compared, not the size of the numbers.

# %%
display(Markdown(NOTE))
paper_styler(latest_paper_table(tracking, "vs_others", release.name))

# %% [markdown]
# ## Table 3: inputs of the network
#
# In the paper depth brings four points at the finest limit. Here the three variants are within each other's intervals.

# %%
paper_styler(latest_paper_table(tracking, "input_variants", release.name))

# %% [markdown]
# ## All methods
#
# The best view of each location at the finest and at the coarsest limit, the best method on top; arrows point to
# methods beyond the axis. Those that know what landmarks are like lead at the finest limit; at the coarsest most are
# alike. Of the rows of Fisher information the best three are shown; all numbers stand in the table at the end.

# %%
from wheretolook.evaluation.results import latest_scores
from wheretolook.figures.scores import regret_figure, score_figure

scores = latest_scores(tracking, release.name)
display(score_figure(scores))

# %% [markdown]
# ## What each method loses
#
# Left, how far a method stays behind the oracle; right, the difference to the set of landmarks on the same locations:
# where the whisker crosses the dashed line, the two cannot be told apart.

# %%
display(regret_figure(scores))

# %% [markdown]
# The same on six interiors made by others, never trained on: differences are larger, and the paper's network is ahead
# of the bins.

# %%
display(regret_figure(latest_scores(tracking, "interiors")))

# %% [markdown]
# ## Seeing through walls
#
# Discs with true occlusion, squares as if every method saw through walls, as the paper's released code does.
# With the walls gone bins and the networks are above all rows of Fisher information, as in the paper, but bins above
# the paper's network. What suffers most is what counts landmarks or sums up their information.

# %%
from wheretolook_paper.figures.occlusion import occlusion_figure

display(occlusion_figure(scores))

# %% [markdown]
# ## Everything in numbers
#
# All that the evaluation tells; `results/scores.md` of the dataset holds the same.

# %%
from wheretolook.evaluation.report import score_markdown

display(Markdown(score_markdown(scores)))
