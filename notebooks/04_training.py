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
# # Training
#
# Does the network learn what it should, is there overfitting, and do its probabilities mean what they say? What is
# shown comes from train runs in the tracking store: those of the release, logged now if they are not there yet, and
# whatever you have trained yourself.

# %%
# %matplotlib inline
from IPython.display import Markdown, display

from wheretolook.notebook import open_release, open_store

release = open_release()
tracking = open_store(release)

# %% [markdown]
# ## The network
#
# The paper's table 1 beside the layers trained here: three fully connected layers, with dropout between. The input is
# 30 × 30 bins of the image, each with the mean of the landmarks in it: their pixel, and depth or position.

# %%
from wheretolook.learning.architecture import architecture_table
from wheretolook.tracking import newest_run

run = newest_run(tracking, "train", params={"dataset": release.name, "variant": "2d+3d"})
architecture_table(run.data.params).style.hide()

# %% [markdown]
# ## What was trained
#
# The newest run of each variant, the best first, on viewpoints of an apartment that none has learnt from. `set` looks
# at landmarks one by one and knows what they are like; `2d`, `2d+z` and `2d+3d` are the paper's network, `released` is
# it as the paper's released code trains it.

# %%
from wheretolook.learning.runs import trained

trained(tracking, release.name).style.hide().format(precision=3, na_rep="–")

# %% [markdown]
# ## Learning curves
#
# Loss and average precision over the epochs, thin and dotted in training, thick in validation; a ring marks the epoch
# whose weights were kept. Where the thick lines turn while the dotted ones go on, the network learns its scenes by
# heart.

# %%
from wheretolook.figures.training import training_figure
from wheretolook.learning.runs import histories

curves = histories(tracking, release.name)
command = "`wheretolook train --config configs/release.yaml`"
display(training_figure(curves) if curves else Markdown(f"No run has a history yet: {command} makes some."))

# %% [markdown]
# ## Calibration
#
# Of all test viewpoints with about the same predicted probability, how many localize? On the dashed line as many as
# predicted. The paper's network promises too much, and dividing its logits by a temperature T, fitted on the validation
# scene, does not mend it; the set of landmarks keeps to the line. Below, how many viewpoints there are.

# %%
from wheretolook.evaluation.calibration import read_calibration
from wheretolook.figures.calibration import calibration_figure
from wheretolook.tracking import newest_artifact

calibration = read_calibration(newest_artifact(tracking, "evaluate", "calibration.csv", release.name))
display(calibration_figure(calibration))
