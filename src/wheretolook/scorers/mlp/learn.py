"""Train the paper's network on binned landmarks."""

from __future__ import annotations

from wheretolook.inputs.channels import CHANNELS
from wheretolook.scorers.mlp import MlpConfig
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network


def learn_mlp(task: TrainingJob, channels: tuple[str, ...]) -> TrainingResult:
    """Train the paper's network over some channels on a dataset's train scenes; raises as `load_views`.

    The views of the network before are used again if they were made with the same options and have the channels.
    """
    options: MlpConfig = task.options
    key = "binned views"
    data: ViewpointDataModule | None = task.kept.get(key)
    if data is None or data.options != options or not {*channels} <= {*data.views.channels}:
        wide = not {*channels} <= {*CHANNELS}
        device = home_device(task.config)
        data = ViewpointDataModule(task.dataset, task.config, options, options.bins, device, task.progress, wide)
        task.kept[key] = data
    data.channels = channels
    spec = NetworkSpec(
        data.statistics.select(channels),
        options.bins,
        options.layout,
        options.hidden,
        options.dropout,
        options.input_dropout,
    )
    return train_network(ViewpointNetwork(spec), data, task, data.class_weights, calibrate=False)
