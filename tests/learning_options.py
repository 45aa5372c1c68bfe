"""Options of training and weights on disk, as tests want them in few words."""

from dataclasses import fields, replace

from synthetic_dataset import CAMERA
from wheretolook.scorers.mlp import MlpConfig
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.training.trained_network import TrainedNetwork


def train_config(*methods, **options):
    """Options of training some methods; see `changed`."""
    named = {"methods": methods} if methods else {}
    return changed(TrainConfig(), **named, **options)


def changed(config, **options):
    """Other options: of a learner as a dictionary, if it is installed; those that no other has are of the MLP's."""
    of_mlp = {option.name for option in fields(MlpConfig)}
    groups = {"mlp": {name: options.pop(name) for name in [*options] if name in of_mlp}}
    groups |= {name: options.pop(name) for name in [*options] if isinstance(options[name], dict)}
    changes = {name: replace(getattr(config, name), **own) for name, own in groups.items() if hasattr(config, name)}
    return replace(config, **options, **changes)


def save_network(
    path, method, network, camera = CAMERA, scale = 1.0,
    offset = 0.0,
):  # fmt: skip
    """Write a network as the weights of a method."""
    TrainedNetwork(method, network, camera, scale, offset).save(path)
    return path
