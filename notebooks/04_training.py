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
# Learning curves, calibration, and what the network responds to, from training runs in the tracking store: those of the
# release, logged now if they are missing, and your own.

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
# The paper's table 1 and the layers trained here: three fully connected layers with dropout. The input is 30 × 30 bins
# of the image, each with the mean pixel of its landmarks, and depth or position.

# %%
from wheretolook.tracking import newest_run
from wheretolook_paper.release.mlp_architecture import paper_architecture_table

run = newest_run(tracking, "train", params={"dataset": release.name, "method": "mlp-2d+3d"})
paper_architecture_table(run.data.params).style.hide()

# %% [markdown]
# ## Training runs
#
# The newest run of each method, validated on scenes not used for training: `set` on eight scenes of all kinds with many
# cameras, the others on one apartment. `set` processes individual landmarks with their attributes; `mlp-2d`, `mlp-2d+z`
# and `mlp-2d+3d` are the paper's network, `mlp-released` is trained like the paper's released code.

# %%
from wheretolook_paper.release.training_histories import trained

trained(tracking, release.name).style.hide().format(precision=3, na_rep="–")

# %% [markdown]
# ## Learning curves
#
# Loss and average precision by epoch, thin and dotted in training, thick in validation; a ring marks the selected
# checkpoint. Diverging lines indicate overfitting.

# %%
from wheretolook_paper.figures.scores import training_figure
from wheretolook_paper.release.training_histories import histories

curves = histories(tracking, release.name)
command = "`wheretolook train --config configs/release.yaml`"
display(training_figure(curves) if curves else Markdown(f"No run has a history yet: {command} makes some."))

# %% [markdown]
# ## Calibration
#
# Of all test viewpoints with about the same predicted probability, the fraction that localizes; the dashed line is
# perfect calibration, a network below it is overconfident. Below, the number of viewpoints. Temperature scaling, fitted
# on the validation scene, changes little: the offset is between scenes, which one parameter cannot fix; on your map
# `wheretolook adapt` calibrates with its photographs.

# %%
from wheretolook.evaluation.statistics import read_calibration
from wheretolook.tracking import newest_artifact
from wheretolook_paper.figures.scores import calibration_figure

calibration = read_calibration(newest_artifact(tracking, "evaluate", "calibration.csv", release.name))
display(calibration_figure(calibration))

# %% [markdown]
# In how many bins more views are predicted to localize than do, and the calibration error before and after scaling:

# %%
import pandas as pd

calibration["overconfident"] = calibration["mean_predicted"] > calibration["share_good"]
before, after = (calibration[calibration["when"] == when].groupby("method") for when in ("before", "after"))
columns = {"bins": before.size(), "bins above what happens": before["overconfident"].sum()}
columns |= {"error": before["ece"].first(), "error, scaled": after["ece"].first(), "T": after["temperature"].first()}
pd.DataFrame(columns).style.format(precision=3)

# %% [markdown]
# ## What the network responds to
#
# The score over the whole sphere of directions at one location, and rendered views at maxima and minima. The network
# has seen none of these images.

# %%
from wheretolook import load_scorer
from wheretolook_paper.figures.network import peaks_figure
from wheretolook_paper.release.showcase import mistaken_location, open_showcase, peaks_of

# %% [markdown]
# A location in an apartment not used for training, where half of all views fail. Its mesh is generated again from its
# seed to render the images.

# %%
showcase = open_showcase(release, "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ### The paper's network
#
# Numbers mark the highest scores among labelled views, letters the lowest, at least 40° apart. Rings localized within 5
# cm and 0.4°, crosses did not. The maxima show shelves, chairs and a patterned carpet, the minima a bare ceiling or a
# dim corner. Below each view is its pose error, if a pose was estimated.

# %%
mlp = load_scorer(showcase.localization_map, release.root / "weights" / "mlp-2d+z.safetensors")
display(peaks_figure(*peaks_of(showcase, mlp, location)))

# %% [markdown]
# ### The set network
#
# The bundled scorer also uses landmark attributes: mapping directions and distances, track length, accuracy. At the
# same location it predicts failures better: on the left of the sphere many landmarks are visible, which the paper's
# network scores highly, yet the views do not localize.

# %%
scorer = load_scorer(showcase.localization_map, release.root / "weights")
display(peaks_figure(*peaks_of(showcase, scorer, location)))

# %% [markdown]
# ### Where they err
#
# The location at eye height with the largest error of the paper's predicted probabilities. Half of the sphere scores
# well and fails.

# %%
mistaken = mistaken_location(showcase, mlp)
display(peaks_figure(*peaks_of(showcase, mlp, mistaken)))

# %% [markdown]
# The set network at that location:

# %%
display(peaks_figure(*peaks_of(showcase, scorer, mistaken)))
