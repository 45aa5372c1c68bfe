"""Learning the paper's network from binned landmarks."""

from __future__ import annotations

from wheretolook.inputs.channels import CHANNELS
from wheretolook.scorers.mlp.config import MlpConfig
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, class_counts, fit_network
from wheretolook.training.trained_network import TrainedNetwork

KEPT = "binned views"
"""What one network leaves for the next in `TrainingJob.kept`: the views, with the options that they were made by."""


def learn_mlp(task: TrainingJob, channels: tuple[str, ...]) -> TrainingResult:
    """The paper's network over these channels from a dataset's train scenes; raises as `load_views`."""
    data = _views(task, channels)
    options = task.options
    statistics = data.statistics.select(channels)
    dropouts = options.dropout, options.input_dropout
    network = ViewpointNetwork(NetworkSpec(statistics, options.bins, options.layout, options.hidden, *dropouts))
    data.channels = channels
    metrics, history = fit_network(network, data, task, data.class_weights)
    labels = data.views.labels.cpu()
    counts = class_counts(train=labels[data.train_rows].numpy(), val=labels[data.val_rows].numpy())
    model = TrainedNetwork(task.method, network.cpu(), task.dataset.camera, training_range=data.training_range)
    return TrainingResult(model, metrics, counts, history)


def _views(task: TrainingJob, channels: tuple[str, ...]) -> ViewpointDataModule:
    """The dataset's views: those of the network before, if they were made by the same options and have the channels."""
    options: MlpConfig = task.options
    known: ViewpointDataModule | None = task.kept.get(KEPT)
    if known is None or known.options != options or not {*channels} <= {*known.views.channels}:
        wide = not {*channels} <= {*CHANNELS}
        device = home_device(task.config)
        known = ViewpointDataModule(task.dataset, task.config, options, options.bins, device, task.progress, wide)
        task.kept[KEPT] = known
    known.setup()
    return known
