"""The paper's network: an MLP over binned landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from wheretolook.inputs.channels import ALL_CHANNELS, PAPER_VARIANTS, Layout
from wheretolook.scorers.registry import Learner, Method, imported, network_scorer
from wheretolook.training.config import FittingConfig, Keep, Schedule
from wheretolook.utils.errors import ConfigError, check_choice, check_range, check_share, no_option


@dataclass(frozen=True)
class MlpConfig(FittingConfig):
    """Options of the paper's network. The defaults are the paper's where it gives values (Sec. 3.3 and 4).

    Args:
        epochs: passes over the training viewpoints (paper: 300).
        batch_size: viewpoints a step, shared out over the devices. The paper gives none; 128 is the released code's.
        learning_rate: Adam's initial learning rate (paper: 1e-3; released code: 1e-4).
        l2: lambda, the factor of the sum of squared weights (paper: a lambda without a value; released code: 0). The
            default was best on two validation apartments, of 1e-4, 1e-3, 3e-3 and 1e-2; with less, the network overfits
            after three epochs.
        schedule: "constant" as in the paper, or "cosine", which lets the rate fall to zero over the epochs.
        dropout: share of hidden units dropped after every ReLU (paper: 0.5).
        input_dropout: share of input values dropped (paper: 0; released code: 0.5).
        hidden: widths of the hidden layers (paper: 300, 300).
        bins: bins along each side of the image (paper: 30).
        layout: "in_place" keeps empty bins where they are, as the paper says; "compact" moves filled bins to the front,
            as its released code does.
        noise_px: standard deviation of noise on (u, v) while training, in pixels (released code: 1).
        noise_m: standard deviation of noise on (x, y, z) while training, in metres (released code: 0.02).
        balance: learn from equally many positive and negative viewpoints. As the paper does (Sec. 4): all of the rarer
            class and a random choice of the other. Validation viewpoints stay as they are.
        keep: "best" keeps the weights of the epoch with the best validation average precision, "last" those of the
            last epoch.
        patience: stop after so many epochs without a better validation average precision; null trains them all.
    """

    epochs: int = 300
    batch_size: int = 128
    learning_rate: float = 1e-3
    l2: float = no_option(3e-3)
    schedule: Schedule = no_option("constant")
    dropout: float = no_option(0.5)
    input_dropout: float = no_option(0.0)
    hidden: tuple[int, ...] = no_option((300, 300))
    bins: int = no_option(30)
    layout: Layout = "in_place"
    noise_px: float = 0.0
    noise_m: float = 0.0
    balance: bool = False
    keep: Keep = no_option("best")
    patience: int | None = no_option(None)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("schedule", self.schedule, ("constant", "cosine"))
        check_choice("layout", self.layout, ("in_place", "compact"))
        check_choice("keep", self.keep, ("best", "last"))
        check_range("bins", self.bins, 1)
        check_range("noise_px", self.noise_px, 0)
        check_range("noise_m", self.noise_m, 0)
        check_share("dropout", self.dropout)
        check_share("input_dropout", self.input_dropout)
        if min(self.hidden, default=1) < 1:
            raise ConfigError("hidden layers must be at least one unit wide", value=self.hidden)
        if self.patience is not None and self.patience < 1:
            raise ConfigError("patience must be at least 1 epoch, or null", value=self.patience)


def _network(name: str, variant: str, channels: tuple[str, ...], settings: Mapping[str, Any] = {}) -> Method:
    learn = partial(imported("wheretolook.scorers.mlp.learn:learn_mlp"), channels=channels)
    return Method(
        name=name,
        about=f"The paper's classifier, {variant}: the predicted probability that a view localizes.",
        build=network_scorer(
            "wheretolook.scorers.mlp.network:BinnedNetworkScorer",
            "wheretolook.scorers.mlp.network:ViewpointNetwork",
            name,
        ),
        weights=name,
        family="mlp",
        probability=True,
        one_camera=True,
        learner=Learner(learn, MlpConfig, settings),
    )


METHODS = (
    _network("mlp-2d", "2d", PAPER_VARIANTS["2d"]),
    _network("mlp-2d+z", "2d + z", PAPER_VARIANTS["2d+z"]),
    _network("mlp-2d+3d", "2d + 3d", PAPER_VARIANTS["2d+3d"]),
    _network("mlp-2d+3d+landmark", "2d + 3d + landmark", ALL_CHANNELS),
    _network(
        "mlp-released",
        "trained as the released code",
        PAPER_VARIANTS["2d+3d"],
        # its options where they can differ from the paper's; batch size (128 there) and epochs stay as configured
        {
            "learning_rate": 1e-4,
            "schedule": "constant",
            "l2": 0.0,
            "dropout": 0.5,
            "input_dropout": 0.5,
            "hidden": (300, 300),
            "layout": "compact",
            "noise_px": 1.0,
            "noise_m": 0.02,
            "balance": True,  # half of each class, so that both have the weight 1
            "keep": "last",
            "patience": None,
        },
    ),
)
