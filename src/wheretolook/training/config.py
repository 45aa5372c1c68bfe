"""Options of training that all learners share, and those of every network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from wheretolook.utils.errors import check_choice, check_positive, check_range, check_share, no_option

Schedule = Literal["constant", "cosine"]
Keep = Literal["best", "last"]


@dataclass(frozen=True)
class SharedConfig:
    """Options of training that all learners share. Each learner's own are in the group of its folder.

    Args:
        methods: what to train, by name or family, such as set and mlp. See `wheretolook evaluate --list-methods`; and
            "matchability", which predicts the detection of landmarks (needs labels with `--label.store_matches true`).
        also: further datasets in the same folder whose train scenes are trained on as well.
        max_error_m: a viewpoint is positive if its position error is strictly smaller, in metres.
        max_error_deg: and if its orientation error is strictly smaller, in degrees.
        val_fraction: share of each training scene's locations held out for validation. Only when the dataset has no
            validation scene.
        seed: seed of all that is random. The split, the balance, initial weights, dropout, noise, the order of batches.
        accelerator: where to train: "auto", "cpu" or "gpu".
        devices: GPUs, or processes on the CPU, to train with. A step takes the same batch however many share it; only
            dropout and noise draw other numbers.
    """

    methods: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    max_error_m: float = no_option(0.05)
    max_error_deg: float = no_option(0.4)
    val_fraction: float = no_option(0.15)
    seed: int = 0
    accelerator: Literal["auto", "cpu", "gpu"] = "auto"
    devices: int = 1

    def __post_init__(self) -> None:
        check_choice("accelerator", self.accelerator, ("auto", "cpu", "gpu"))
        check_positive("max_error_m", self.max_error_m)
        check_positive("max_error_deg", self.max_error_deg)
        check_range("devices", self.devices, 1)
        check_share("val_fraction", self.val_fraction)
        check_positive("val_fraction", self.val_fraction)


DECIDING = ("max_error_m", "max_error_deg", "val_fraction", "seed")
"""Fields of `SharedConfig` that decide what a learner learns."""


@dataclass(frozen=True)
class FittingConfig:
    """Options of a network that Adam fits to all views, with a learning rate that falls to zero by a cosine.

    The weights of the epoch with the best validation average precision are kept. A network that is trained in another
    way declares `schedule`, `keep`, `patience` or `balance` as options of its own.

    Args:
        epochs: passes over the training viewpoints.
        batch_size: viewpoints a step, shared out over the devices.
        learning_rate: Adam's initial rate.
        l2: factor of the sum of squared weights.
    """

    epochs: int = no_option(20)
    batch_size: int = no_option(512)
    learning_rate: float = no_option(2e-3)
    l2: float = no_option(1e-5)

    def __post_init__(self) -> None:
        check_range("epochs", self.epochs, 1)
        check_range("batch_size", self.batch_size, 1)
        check_positive("learning_rate", self.learning_rate)
        check_range("l2", self.l2, 0)

    @property
    def schedule(self) -> Schedule:
        """How the learning rate changes."""
        return "cosine"

    @property
    def keep(self) -> Keep:
        """Whether the weights of the best epoch are kept, or those of the last."""
        return "best"

    @property
    def patience(self) -> int | None:
        """Epochs without a better validation average precision after which to stop; None trains them all."""
        return None

    @property
    def balance(self) -> bool:
        """Whether to learn from equally many positive and negative viewpoints."""
        return False

    @property
    def starts_from(self) -> str:
        """Name of the method whose weights in the dataset's folder, if there are any, training starts from."""
        return ""
