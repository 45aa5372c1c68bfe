"""Train the convolutional network on binned landmarks."""

from __future__ import annotations

from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network
from wheretolook_paper.scorers.conv.network import ConvNetwork, ConvSpec


def learn_conv(task: TrainingJob) -> TrainingResult:
    """Train a convolutional network on a dataset's train scenes, calibrated on validation views; raises as `load_views`."""
    options = task.options
    device = home_device(task.config)
    data = ViewpointDataModule(task.dataset, task.config, options, options.bins, device, task.progress, True)
    network = ConvNetwork(ConvSpec(data.statistics, options.bins, options.widths, options.dropout))
    return train_network(network, data, task)
