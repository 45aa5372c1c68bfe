"""Learning the convolutional network from binned landmarks."""

from __future__ import annotations

from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, class_counts, fit_network, fit_platt, predict
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook_paper.scorers.conv.network import ConvNetwork, ConvSpec


def learn_conv(task: TrainingJob) -> TrainingResult:
    """A convolutional network from a dataset's train scenes, calibrated on validation views; raises as `load_views`."""
    options = task.options
    device = home_device(task.config)
    data = ViewpointDataModule(task.dataset, task.config, options, options.bins, device, task.progress, True)
    data.setup()
    network = ConvNetwork(ConvSpec(data.statistics, options.bins, options.widths, options.dropout))
    metrics, history = fit_network(network, data, task)
    calibration = fit_platt(*predict(network.to(device), data))
    labels = data.views.labels.cpu()
    counts = class_counts(train=labels[data.train_rows].numpy(), val=labels[data.val_rows].numpy())
    model = TrainedNetwork(task.method, network.cpu(), task.dataset.camera, *calibration, data.training_range)
    return TrainingResult(model, metrics, counts, history)
