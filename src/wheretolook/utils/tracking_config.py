"""Where MLflow keeps its runs: options only, so that the command line reads them without MLflow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrackingConfig:
    """Where runs are logged.

    Args:
        folder: folder of the MLflow store. Made when needed; holds `mlflow.db` and `artifacts/`.
        experiment: name of one MLflow experiment that all runs belong to; if not given, each dataset and purpose has
            its own, such as `release: evaluation` (`wheretolook.utils.tracking_layout`), and older ones are read, too.
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
        """Artifact location of the experiment."""
        return str(self.root / "artifacts")
