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
# # Training
#
# Does the network learn what it should, is there overfitting, do its probabilities mean what they say, and what does
# it look at? What is shown comes from train runs in the tracking store: those of the release, logged now if they are
# not there yet, and whatever you have trained yourself.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import Markdown, display

from wheretolook_paper.release.notebook import open_release, open_store

release = open_release()
tracking = open_store(release)

# %% [markdown]
# ## The network
#
# The paper's table 1 beside the layers trained here: three fully connected layers, with dropout between. The input is
# 30 × 30 bins of the image, each with the mean of the landmarks in it: their pixel, and depth or position.

# %%
from wheretolook.tracking.runs import newest_run
from wheretolook_paper.release.paper_architecture import paper_architecture_table

run = newest_run(tracking, "train", params={"dataset": release.name, "method": "mlp-2d+3d"})
paper_architecture_table(run.data.params).style.hide()

# %% [markdown]
# ## What was trained
#
# The newest run of each method, on viewpoints of scenes that it has not learnt from: `set` on eight of all kinds,
# looked at by many cameras, the others on one apartment. `set` looks at landmarks one by one and knows what they are
# like; `mlp-2d`, `mlp-2d+z` and `mlp-2d+3d` are the paper's network, `mlp-released` is it as the paper's released code
# trains it.

# %%
from wheretolook_paper.release.training_histories import trained

trained(tracking, release.name).style.hide().format(precision=3, na_rep="–")

# %% [markdown]
# ## Learning curves
#
# Loss and average precision over the epochs, thin and dotted in training, thick in validation; a ring marks the epoch
# whose weights were kept. Where the thick lines turn while the dotted ones go on, the network learns its scenes by
# heart.

# %%
from wheretolook_paper.figures.training import training_figure
from wheretolook_paper.release.training_histories import histories

curves = histories(tracking, release.name)
command = "`wheretolook train --config configs/release.yaml`"
display(training_figure(curves) if curves else Markdown(f"No run has a history yet: {command} makes some."))

# %% [markdown]
# ## Calibration
#
# Of all test viewpoints with about the same predicted probability, how many localize? On the dashed line as many as
# predicted. The paper's network promises too much here, the set of landmarks a little too little. The reason is not
# that either is too sure in general: the temperature T that divides its logits is fitted on the validation scene, and
# comes out near 1. What is off is the difference between that scene and these two, which no single number mends; on a
# map of one's own, `wheretolook adapt` learns it from the map's photographs. Below, how many viewpoints there are.

# %%
from wheretolook.evaluation.calibration import read_calibration
from wheretolook.figures.calibration import calibration_figure
from wheretolook.tracking.runs import newest_artifact

calibration = read_calibration(newest_artifact(tracking, "evaluate", "calibration.csv", release.name))
display(calibration_figure(calibration))

# %% [markdown]
# ## What the network looks at
#
# **Does the network look where a person would?** Its score over the whole sphere of directions at one place, and the
# rendered views behind the peaks and the pits. The network has seen none of these images: it knows landmarks and poses.

# %%
from wheretolook import load_scorer
from wheretolook_paper.figures.peaks import peaks_figure
from wheretolook_paper.release.showcase import open_showcase
from wheretolook_paper.release.showcase_figures import mistaken_location, peaks_of

# %% [markdown]
# The place is one of an apartment that none of them has learnt from, where half of all views fail. Its mesh is
# generated anew from its seed to render what the camera sees.

# %%
showcase = open_showcase(release, "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ### The paper's network
#
# Numbers mark the highest scores among views that were labelled, letters the lowest, none within 40° of another of its
# kind. Rings localized within 5 cm and 0.4°, crosses did not. The peaks turn out to show shelves, chairs and a
# patterned carpet, the pits a bare ceiling or a dim corner. Below each view stands how far off the pose was that was
# found, if one was.

# %%
mlp = load_scorer(release.root / "weights" / "mlp-2d+z.safetensors", showcase.localization_map)
display(peaks_figure(*peaks_of(showcase, mlp, location)))

# %% [markdown]
# ### The set network
#
# The scorer that ships also knows what each landmark is like: from where it was mapped, how often, how exactly. At the
# same place it tells better what fails: on the left of the sphere there are landmarks enough to please the paper's
# network, which only knows where they are, yet views do not localize.

# %%
scorer = load_scorer(release.root / "weights", showcase.localization_map)
display(peaks_figure(*peaks_of(showcase, scorer, location)))

# %% [markdown]
# ### Where they err
#
# The place where the probabilities of the paper's network are farthest from what happened, of all at the height of
# eyes. Half of the sphere looks fine to it and fails.

# %%
mistaken = mistaken_location(showcase, mlp)
display(peaks_figure(*peaks_of(showcase, mlp, mistaken)))

# %% [markdown]
# The set network at that place:

# %%
display(peaks_figure(*peaks_of(showcase, scorer, mistaken)))
