"""Labels without people: render a viewpoint, localize the image against the map, measure the pose error."""

from wheretolook.labelling.labeller import LabelConfig, label_viewpoints
from wheretolook.labelling.localizer import Localization, Localizer, LocalizerConfig

__all__ = ["LabelConfig", "Localization", "Localizer", "LocalizerConfig", "label_viewpoints"]
