"""Location of the MLflow store. Imports no MLflow, so that the command line can read it quickly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrackingConfig:
    """Where runs are logged.

    Args:
        folder: folder of the MLflow store. Created when needed; holds `mlflow.db` and `artifacts/`.
        experiment: name of one MLflow experiment for all runs; by default, each dataset and purpose has its own, such
            as `release: evaluation`.
    """

    folder: str = "mlruns"
    experiment: str = ""

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
        """Artifact location of the experiments."""
        return str(self.root / "artifacts")
