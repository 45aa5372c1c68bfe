"""Where MLflow keeps its runs: options only, so that the command line reads them without MLflow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrackingConfig:
    """Where runs are logged.

    Args:
        folder: folder of the MLflow store. Made when needed; holds `mlflow.db` and `artifacts/`.
        experiment: name of the MLflow experiment that the runs belong to.
    """

    folder: str = "mlruns"
    experiment: str = "wheretolook"

    @property
    def root(self) -> Path:
        """Absolute path of the store's folder."""
        return Path(self.folder).expanduser().resolve()

    @property
    def uri(self) -> str:
        """Tracking URI of the store."""
        return f"sqlite:///{self.root / 'mlflow.db'}"

    @property
    def artifacts(self) -> str:
        """Artifact location of the experiment."""
        return str(self.root / "artifacts")
