"""Names of a dataset's files and of its views' outcomes, apart from the code that reads them."""

from __future__ import annotations

RELEASE = "release"  # name of the released dataset
RELEASE_FILE = "release.json"  # what a release was made from; the file that makes a dataset one
LOCK = ".lock"  # in a dataset's folder: held by stages that change it, shared by those that read it

LOCALIZED = "localized"
TOO_FEW_MATCHES = "too_few_matches"
NO_POSE = "no_pose"
CONTRADICTED = "contradicted"  # of a rig: there is a pose, but the images contradict the given rotations
