"""Labels the viewpoints of one scene, as `wheretolook.localization.labeller.label_scenes` does those of many."""

from wheretolook.features.extractor import ExtractorConfig
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import LabelTask, label_scenes
from wheretolook.localization.shard import SceneJob


def label_viewpoints(
    table,
    mesh,
    landmarks,
    camera,
    shards,
    config=None,
    extractor=None,
    device="cpu",
    progress=True,
    description="label",
):
    """`label_scenes` for one scene, of the parts of a `SceneJob` and a `LabelTask`: the table with its labels."""
    config = config or LabelConfig()
    extractor = extractor or ExtractorConfig()
    job = SceneJob(
        mesh, landmarks, camera, config.localizer, extractor, device, config.store_matches, appearance=config.appearance
    )
    (scene,) = label_scenes([LabelTask(description, job, table, shards)], config, progress, description)
    return scene.table
