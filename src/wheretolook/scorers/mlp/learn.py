"""Train the paper's network on binned landmarks."""

from __future__ import annotations

from wheretolook.inputs.channels import CHANNELS
from wheretolook.scorers.mlp import MlpConfig
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network

BINNED_VIEWS = "binned views"  # key in `TrainingJob.kept` of the views that one network leaves for the next


def learn_mlp(task: TrainingJob, channels: tuple[str, ...]) -> TrainingResult:
    """Train the paper's network over some channels on a dataset's train scenes; raises as `load_views`.

    The views of the network before are used again if they were made with the same options and have the channels.
    """
    options: MlpConfig = task.options
    data: ViewpointDataModule | None = task.kept.get(BINNED_VIEWS)
    if data is None or data.options != options or not {*channels} <= {*data.views.channels}:
        wide = not {*channels} <= {*CHANNELS}
        device = home_device(task.config)
        data = ViewpointDataModule(task.dataset, task.config, options, options.bins, device, task.progress, wide)
        task.kept[BINNED_VIEWS] = data
    data.channels = channels
    statistics = data.statistics.select(channels)
    dropouts = options.dropout, options.input_dropout
    network = ViewpointNetwork(NetworkSpec(statistics, options.bins, options.layout, options.hidden, *dropouts))
    return train_network(network, data, task, data.class_weights, calibrate=False)
