"""Train the network that scores all directions at a location."""

from __future__ import annotations

from wheretolook.training.data import check_classes, validation_views
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network
from wheretolook.training.scenes import training_scenes
from wheretolook_paper.scorers.sphere.network import SphereNetwork
from wheretolook_paper.scorers.sphere.views import SphereDataModule, load_sphere_views


def learn_sphere(task: TrainingJob) -> TrainingResult:
    """Train a `SphereNetwork` on a dataset's train scenes, calibrated on the validation views.

    Raises a TableError if there is no train scene, no labels, or labels of one class only; a MapError if a scene's
    mapping cameras are not known.
    """
    dataset = task.dataset
    config = task.config
    scenes = training_scenes(dataset)
    device = home_device(config)
    views = load_sphere_views(dataset, scenes, config, task.options, device, task.progress)
    held_out = validation_views(dataset, views.scene, views.location, config)
    labels = views.labels.numpy() > 0
    check_classes(dataset, config, labels[~held_out], labels[held_out])
    data = SphereDataModule(views, held_out, task.options.batch_size, config)
    return train_network(SphereNetwork(task.options), data, task)
