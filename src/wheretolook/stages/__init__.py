"""The stages, one function each, for Python, notebooks and the command line alike.

A stage works through the scenes of an experiment and leaves its result on disk. Up to training, a record says what the
result was made from: called again, a stage reuses what is there if its settings and inputs are the same.
"""

from wheretolook.stages.adapt import adapt
from wheretolook.stages.evaluate import evaluate
from wheretolook.stages.label import label
from wheretolook.stages.map import make_maps
from wheretolook.stages.plan import plan
from wheretolook.stages.sample import sample
from wheretolook.stages.scenes import make_scenes
from wheretolook.stages.train import train
from wheretolook.stages.viewpoint_map import viewpoint_map
from wheretolook_paper.commands.compare_paths import compare_paths
from wheretolook_paper.commands.figures import figures
from wheretolook_paper.commands.log_release import log_release
from wheretolook_paper.commands.release import release

__all__ = [
    "adapt",
    "compare_paths",
    "evaluate",
    "figures",
    "label",
    "log_release",
    "make_maps",
    "make_scenes",
    "plan",
    "release",
    "sample",
    "train",
    "viewpoint_map",
]
