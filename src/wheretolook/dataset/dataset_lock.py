"""Which stages may run on a dataset beside which: one that changes it runs alone, those that only read it together."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from wheretolook.dataset.names import LOCK
from wheretolook.utils.locks import hold

P = ParamSpec("P")
R = TypeVar("R")


def changes_dataset(stage: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Of a function of an experiment: while it runs, no other stage runs on the dataset. InUseError if one does."""
    return _holding(stage, shared=False)


def reads_dataset(stage: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Of a function of an experiment: while it runs, no stage changes the dataset. InUseError if one does."""
    return _holding(stage, shared=True)


@contextmanager
def changing(root: Path, stage: str) -> Iterator[None]:
    """Within this block no other stage runs on the dataset in this folder. Raises InUseError if one does.

    What killed runs left half written is removed first: nobody writes it any more.
    """
    with hold(root / LOCK, stage):
        _remove_leftovers(root)
        yield


@contextmanager
def reading(root: Path, stage: str, makes: str = "") -> Iterator[None]:
    """Nothing changes the dataset in this folder while a stage reads it; what it makes of it, it alone makes.

    Raises InUseError if another stage changes the dataset, or makes the same: "weights", "results" or "paths".
    """
    with hold(root / LOCK, stage, shared=True):
        if not makes or not root.is_dir():  # without a dataset nothing is made
            yield
            return
        with hold(root / f".{makes}{LOCK}", stage):
            yield


def _remove_leftovers(root: Path) -> None:
    for pattern in (f".?*{LOCK}", "*.partial", "*/*.partial", "*/*/*.partial", "*/*/*/*.partial"):
        for path in root.glob(pattern):
            if not path.parent.resolve().is_relative_to(root.resolve()):
                continue  # a link leads there, which the stage will refuse
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(OSError):
                    path.unlink()


def _holding(stage: str, shared: bool) -> Callable[[Callable[P, R]], Callable[P, R]]:
    def of(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def alone(*args: P.args, **kwargs: P.kwargs) -> R:
            experiment: Any = args[0] if args else kwargs["experiment"]
            try:
                with (reading if shared else changing)(experiment.root, stage):
                    return function(*args, **kwargs)
            finally:
                with suppress(OSError):  # made for the lock of a stage that then found nothing to work on
                    experiment.root.rmdir()

        return alone

    return of
