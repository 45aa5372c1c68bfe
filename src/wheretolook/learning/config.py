"""Options of training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from wheretolook.inputs.bins import CHANNELS, INPUT_VARIANTS, PAPER_VARIANTS, Layout
from wheretolook.learning.fitting_config import FittingConfig
from wheretolook.methods.conv.config import ConvConfig
from wheretolook.methods.matchability.config import MatchabilityConfig
from wheretolook.methods.set.config import SetConfig
from wheretolook.methods.sphere.config import SphereConfig
from wheretolook.methods.trees.config import TreesConfig
from wheretolook.utils.errors import ConfigError

RELEASED = "released"
"""The variant that trains as the paper's released code does, on the inputs of "2d+3d"."""

TREES = "trees"
"""The variant that is no network: boosted trees on pooled statistics of what landmarks are like."""

MATCHABILITY = "matchability"
"""The variant that tells which landmarks will be found, for methods that weight them by it."""

SET = "set"
"""The variant that scores a view by the set of landmarks it sees."""

CONV = "conv"
"""The variant that is a convolutional network over the bins, which also knows what landmarks are like."""

SPHERE = "sphere"
"""The variant that scores all directions at a location at once, in the manner of ActLoc."""

NETWORKS = (*PAPER_VARIANTS, RELEASED)
"""The paper's networks, of which a release ships one."""

LEARNERS = (TREES, MATCHABILITY, CONV, SET, SPHERE)
"""Variants that are not the paper's network. Each has its options in the field of its name in `TrainConfig`, and learns
by a function in the module of its name in `wheretolook.learning`."""

VARIANTS = (*INPUT_VARIANTS, RELEASED, *LEARNERS)
"""All that can be trained."""

RELEASED_OPTIONS: dict[str, Any] = {
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
}
"""Options of the released code where they can differ from the paper's; batch size (128 there) and epochs stay as
configured."""


@dataclass(frozen=True)
class TrainConfig:
    """Options of training. The defaults are the paper's where it says something (Sec. 3.3 and 4).

    Args:
        variants: what to train: networks by their inputs, "2d", "2d+z" and "2d+3d", and "2d+3d+landmark", which is
            also told what landmarks are like; "released", which has the inputs "2d+3d" and learns with the options of
            the paper's released code instead of those here; and learners that know what landmarks are like, with
            options of their own and none of the network's: "trees", boosted trees on statistics of the landmarks in
            view; "conv", a convolutional network over the bins; "set", a network over landmarks one by one;
            "sphere", one that scores all directions at a location at once; and "matchability", which tells which
            landmarks will be found (needs labels with `--label.store_matches true`).
        epochs: passes over the training viewpoints (paper: 300).
        batch_size: viewpoints a step, shared out over the devices (the paper gives none; 128 is the released code's).
        learning_rate: Adam's initial learning rate (paper: 1e-3; released code: 1e-4).
        schedule: "constant" as in the paper, or "cosine", which lets the rate fall to zero over the epochs.
        l2: lambda, the factor of the sum of squared weights (paper: a lambda without a value; released code: 0). The
            default was best on two validation apartments, of 1e-4, 1e-3, 3e-3 and 1e-2; with less, the network overfits
            after three epochs.
        dropout: share of hidden units dropped after every ReLU (paper: 0.5).
        input_dropout: share of input values dropped (paper: 0; released code: 0.5).
        hidden: widths of the hidden layers (paper: 300, 300).
        bins: bins along each side of the image (paper: 30).
        layout: "in_place" keeps empty bins where they are, as the paper says; "compact" moves filled bins to the front,
            as its released code does.
        noise_px: standard deviation of noise on (u, v) while training, in pixels (released code: 1).
        noise_m: standard deviation of noise on (x, y, z) while training, in metres (released code: 0.02).
        max_error_m: a viewpoint is positive if its position error is strictly smaller, in metres.
        max_error_deg: and its orientation error too, in degrees.
        val_fraction: share of the locations of each training scene held out for validation when the dataset has no
            validation scene.
        balance: learn from equally many positive and negative viewpoints, as the paper does (Sec. 4): all of the rarer
            class and a random choice of the other. Validation viewpoints stay as they are.
        keep: "best" keeps the weights of the epoch with the best validation average precision, "last" those of the
            last epoch.
        patience: stop after so many epochs without a better validation average precision; null trains them all.
        also: names of further datasets in the same folder; their train scenes are learnt from as well.
        seed: seed of the split, the balance, the initial weights, dropout, noise and the order of batches.
        accelerator: where to train: "auto", "cpu" or "gpu".
        devices: GPUs, or processes on the CPU, to train with. One step of many is one step of one: each takes its share
            of the same batch. Dropout and noise draw other numbers, though.
        trees: options of "trees".
        matchability: options of "matchability".
        set: options of "set".
        conv: options of "conv".
        sphere: options of "sphere".
    """

    variants: tuple[str, ...] = (*PAPER_VARIANTS, SET)
    epochs: int = 300
    batch_size: int = 128
    learning_rate: float = 1e-3
    schedule: Literal["constant", "cosine"] = "constant"
    l2: float = 3e-3
    dropout: float = 0.5
    input_dropout: float = 0.0
    hidden: tuple[int, ...] = (300, 300)
    bins: int = 30
    layout: Layout = "in_place"
    noise_px: float = 0.0
    noise_m: float = 0.0
    max_error_m: float = 0.05
    max_error_deg: float = 0.4
    val_fraction: float = 0.15
    balance: bool = False
    keep: Literal["best", "last"] = "best"
    patience: int | None = None
    also: tuple[str, ...] = ()
    seed: int = 0
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    devices: int = 1
    trees: TreesConfig = field(default_factory=TreesConfig)
    matchability: MatchabilityConfig = field(default_factory=MatchabilityConfig)
    set: SetConfig = field(default_factory=SetConfig)
    conv: ConvConfig = field(default_factory=ConvConfig)
    sphere: SphereConfig = field(default_factory=SphereConfig)

    def __post_init__(self) -> None:
        unknown = [name for name in self.variants if name not in VARIANTS]
        if unknown or not self.variants or len(set(self.variants)) < len(self.variants):
            known = f"There are {', '.join(VARIANTS)}."
            raise ConfigError("variants must be known and named once", value=self.variants, fix=known)
        for name, choices in (
            ("schedule", ("constant", "cosine")),
            ("layout", ("in_place", "compact")),
            ("keep", ("best", "last")),
            ("accelerator", ("auto", "cpu", "gpu")),
        ):
            if getattr(self, name) not in choices:
                raise ConfigError(f"unknown {name}", value=getattr(self, name), fix=f"Use {' or '.join(choices)}.")
        for name in ("epochs", "batch_size", "bins", "devices"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1", value=getattr(self, name))
        for name in ("learning_rate", "max_error_m", "max_error_deg"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", value=getattr(self, name))
        for name in ("l2", "noise_px", "noise_m"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative", value=getattr(self, name))
        for name in ("dropout", "input_dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 0 and less than 1", value=getattr(self, name))
        if not 0 < self.val_fraction < 1:
            raise ConfigError("val_fraction must lie strictly between 0 and 1", value=self.val_fraction)
        if min(self.hidden, default=1) < 1:
            raise ConfigError("hidden layers must be at least one unit wide", value=self.hidden)
        if self.patience is not None and self.patience < 1:
            raise ConfigError("patience must be at least 1 epoch, or null", value=self.patience)

    def of_variant(self, variant: str) -> TrainConfig:
        """The options that a variant is trained with."""
        if variant == RELEASED:
            return replace(self, **RELEASED_OPTIONS)
        own = getattr(self, variant) if variant in LEARNERS else None
        if isinstance(own, FittingConfig):
            return replace(
                self, epochs=own.epochs, batch_size=own.batch_size, learning_rate=own.learning_rate, l2=own.l2,
                schedule="cosine", keep="best", patience=None, balance=False,
            )  # fmt: skip
        return self


def weights_name(variant: str) -> str:
    """File in a dataset's `weights` folder of what a variant has learnt."""
    return f"{variant}.safetensors" if variant in LEARNERS else f"mlp-{variant}.safetensors"


def inputs_of(variant: str) -> str:
    """The key in `wheretolook.inputs.bins.INPUT_VARIANTS` of what a variant looks at."""
    return "2d+3d" if variant == RELEASED else variant


def needs_landmark_channels(variant: str) -> bool:
    """Whether a variant of the paper's network looks at more than `wheretolook.inputs.bins.CHANNELS`."""
    return not {*INPUT_VARIANTS[inputs_of(variant)]} <= {*CHANNELS}
