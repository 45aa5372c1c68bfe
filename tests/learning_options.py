"""Options of training and weights on disk, as tests want them in few words."""

from dataclasses import fields, replace

from synthetic_dataset import CAMERA
from wheretolook.scorers.mlp import MlpConfig
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.training.trained_network import TrainedNetwork

OF_MLP = {option.name for option in fields(MlpConfig)}


def train_config(*methods, **options):
    """Options of training some methods; those that not all learners share are of the paper's network."""
    own = {name: value for name, value in options.items() if name in OF_MLP}
    rest = {name: value for name, value in options.items() if name not in OF_MLP}
    named = {"methods": methods} if methods else {}
    return TrainConfig(**named, mlp=MlpConfig(**own), **rest)


def changed(config, **options):
    """Other options; those that not all learners share are of the paper's network."""
    own = {name: value for name, value in options.items() if name in OF_MLP}
    rest = {name: value for name, value in options.items() if name not in OF_MLP}
    return replace(config, mlp=replace(config.mlp, **own), **rest)


def save_network(
    path, method, network, camera = CAMERA, scale = 1.0,
    offset = 0.0,
):  # fmt: skip
    """Write a network as the weights of a method."""
    TrainedNetwork(method, network, camera, scale, offset).save(path)
    return path
