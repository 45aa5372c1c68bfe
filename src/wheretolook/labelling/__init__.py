"""Labels without annotators: render a viewpoint, localize the image against the map, measure the pose error."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheretolook.labelling.config import LabelConfig, LocalizerConfig

if TYPE_CHECKING:
    from wheretolook.labelling.labeller import LabelTask, label_scenes, label_viewpoints
    from wheretolook.labelling.localizer import Localization, Localizer

__all__ = [
    "LabelConfig",
    "LabelTask",
    "Localization",
    "Localizer",
    "LocalizerConfig",
    "label_scenes",
    "label_viewpoints",
]


def __getattr__(name: str) -> Any:
    if name in ("LabelTask", "label_scenes", "label_viewpoints"):  # loads PyTorch and pycolmap
        from wheretolook.labelling import labeller

        return getattr(labeller, name)
    if name in ("Localization", "Localizer"):
        from wheretolook.labelling import localizer

        return getattr(localizer, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
