"""Read and write locks of a dataset: a stage that changes it runs alone, stages that read it run together."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from wheretolook.dataset.config import LOCK
from wheretolook.utils.processes import hold

P = ParamSpec("P")
R = TypeVar("R")


@contextmanager
def changing(root: Path, stage: str) -> Iterator[None]:
    """Hold the write lock of the dataset in a folder, and remove partial files of killed runs.

    Raises InUseError if another stage runs on it.
    """
    with hold(root / LOCK, stage):
        _remove_leftovers(root)
        yield


@contextmanager
def reading(root: Path, stage: str, makes: str = "") -> Iterator[None]:
    """Hold the read lock of the dataset in a folder, and the write lock of one kind of result.

    `makes` is "weights", "results" or "paths". Raises InUseError if another stage changes the dataset, or makes the
    same kind of result.
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
                continue  # only files within the dataset are deleted
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with suppress(OSError):
                    path.unlink()


def _decorator(
    lock: Callable[[Path, str], AbstractContextManager[None]], stage: str
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate `run` of a command, whose dataset is in `root`, to hold a lock of the dataset."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def locked(*args: P.args, **kwargs: P.kwargs) -> R:
            command: Any = args[0]
            with lock(command.root, stage):
                return function(*args, **kwargs)

        return locked

    return decorate


changes_dataset = partial(_decorator, changing)
reads_dataset = partial(_decorator, reading)
"""Decorators by the name of a stage. They raise InUseError as `changing` and `reading` do."""
