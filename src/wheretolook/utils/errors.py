"""Errors a user can act on: each names the file, the value, and the fix."""

from __future__ import annotations

from os import PathLike


class WhereToLookError(Exception):
    """Base of all errors on bad input. The command line exits with code 2 on it.

    `problem` is one sentence. `path` is the file or folder, and `value` the value, that it is about, if there is one;
    `fix` is what the user can do.
    """

    def __init__(
        self, problem: str, *, path: str | PathLike[str] | None = None, value: object = None, fix: str | None = None
    ) -> None:
        self.problem = problem
        self.path = path
        self.value = value
        self.fix = fix
        message = problem if path is None else f"{path}: {problem}"
        if value is not None:
            message += f" (got {value!r})"
        if fix is not None:
            message += f". {fix}"
        super().__init__(message)

    def __str__(self) -> str:
        """Return the message; if a file could not be read for lack of permission, that is the message."""
        cause = self.__cause__
        while cause is not None and not isinstance(cause, PermissionError):
            cause = cause.__cause__
        if cause is None or isinstance(self, StorageError):
            return super().__str__()
        return f"{cause.filename or self.path}: Permission denied"


class ConfigError(WhereToLookError):
    """A configuration has an unknown key or a value out of range."""


class SceneError(WhereToLookError):
    """A mesh is missing, empty, untextured, not finite, or leaves no free space."""


class MapError(WhereToLookError):
    """A COLMAP model is missing, empty, unreadable or lacks what a stage needs."""


class TableError(WhereToLookError):
    """A table of viewpoints is missing, truncated or lacks columns or labels."""


class WorkerError(WhereToLookError):
    """A worker process ended before its work was done."""


class StorageError(WhereToLookError):
    """A result cannot be written, or was removed after it was written."""


class InUseError(WhereToLookError):
    """Another process holds the lock on a dataset or a store."""


class TrackingError(StorageError):
    """The MLflow store cannot be used, or something cannot be logged to it."""


class WeightsError(WhereToLookError):
    """Trained weights are missing or do not fit the network or the inputs asked for."""


class CameraError(WeightsError):
    """Weights were trained on views of another camera, and do not apply to this one."""


class MapFormatError(WhereToLookError):
    """A saved viewpoint map is missing, damaged or of another version."""


class MissingRunError(WhereToLookError):
    """A figure needs a run that the tracking store does not have."""


class OutOfRangeWarning(UserWarning):
    """Views are outside the training distribution of a scorer, so that its scores are less reliable."""


class MapWarning(UserWarning):
    """A map is used only in part, or may not be in metres with z up."""


class LockWarning(UserWarning):
    """A file system has no locks, so that two processes may write at once."""


class TrackingWarning(UserWarning):
    """Results are on disk, but are not logged."""


class PoseError(WhereToLookError, ValueError):
    """Poses, locations or directions have the wrong shape, are not finite, or are zero directions."""


class PlanningError(WhereToLookError):
    """There is no path, or no sequence of views along it within the camera's limits."""
