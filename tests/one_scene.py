"""Labels the viewpoints of one scene, as `wheretolook.localization.labeller.label_scenes` does those of many."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import LabelTask, label_scenes
from wheretolook.localization.shard import SceneJob


def label_viewpoints(
    table: pd.DataFrame,
    mesh: Path,
    landmarks: Path,
    camera: PinholeCamera,
    shards: Path,
    config: LabelConfig | None = None,
    extractor: ExtractorConfig | None = None,
    device: str = "cpu",
    progress: bool = True,
    description: str = "label",
) -> pd.DataFrame:
    """`label_scenes` for one scene, of the parts of a `SceneJob` and a `LabelTask`: the table with its labels."""
    config = config or LabelConfig()
    extractor = extractor or ExtractorConfig()
    job = SceneJob(
        mesh, landmarks, camera, config.localizer, extractor, device, config.store_matches, appearance=config.appearance
    )
    (scene,) = label_scenes([LabelTask(description, job, table, shards)], config, progress, description)
    return scene.table
