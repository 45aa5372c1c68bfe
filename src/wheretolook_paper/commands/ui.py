"""`wheretolook ui`: MLflow in the browser, at the comparison of methods."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.client import HTTPConnection

from wheretolook.commands.options import Command
from wheretolook.tracking import TrackingConfig
from wheretolook.utils.errors import ConfigError, MissingRunError
from wheretolook_paper.experiment_notes import experiment_link, first_view

ADDRESS = "127.0.0.1"
NAME = "mlflow.localhost"
"""Name of this machine in links: under the names localhost and 127.0.0.1, MLflow's page opens its assistant."""

SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_ENABLE_AI_GATEWAY": "false",
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_SERVER_ALLOWED_HOSTS": f"{NAME}:*,localhost:*,{ADDRESS}:*",
    "MLFLOW_SERVER_CORS_ALLOWED_ORIGINS": f"http://{NAME}:*",
}
"""Environment of MLflow's server."""

WAIT_S = 180.0  # until the server responds; half a minute on two cores


@dataclass(frozen=True, kw_only=True)
class Ui(Command):
    """Open MLflow on logged runs, at the comparison of methods, until Ctrl-C.

    Prints a link for each comparison in the store, and opens the first where there is a display. MLflow serves this
    machine only, without its telemetry and assistant.

    Examples:
      wheretolook ui --port 5001
      wheretolook ui --tracking.folder elsewhere/mlruns

    Args:
        tracking: where MLflow keeps its runs.
        port: port to serve at.
    """

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    port: int = 5000

    def run(self) -> None:
        """Serve until interrupted. Raises MissingRunError without a store, ConfigError if the port cannot be used."""
        from wheretolook.view.server import check_port

        check_port(ADDRESS, self.port)
        links = comparisons(self.tracking, f"http://{NAME}:{self.port}")
        print("starting MLflow's server, half a minute", flush=True)
        try:
            with serving(self.tracking, self.port) as server:
                print(*(f"{name:<24}{link}" for name, link in links.items()), "Ctrl-C ends it", sep="\n", flush=True)
                if sys.platform == "darwin" or {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
                    webbrowser.open(next(iter(links.values())))
                server.wait()
        except KeyboardInterrupt:
            print("ended")


@contextmanager
def serving(tracking: TrackingConfig, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Run MLflow's server while the context is open. Raises ConfigError if it does not start."""
    with subprocess.Popen(_server_command(tracking, port), env=os.environ | SETTINGS) as server:
        try:
            _wait_for(server, port)
            yield server
        finally:
            server.terminate()


def comparisons(tracking: TrackingConfig, server: str) -> dict[str, str]:
    """Return links to the comparisons of a store, at the address of its server, by the names of their experiments.

    Evaluations are first. Raises MissingRunError if there is no store.
    """
    from wheretolook.tracking import client

    if not (tracking.root / "mlflow.db").is_file():
        fix = "Run a stage first, such as `wheretolook log-release`, or name the folder: --tracking.folder FOLDER."
        raise MissingRunError("no runs are logged here", path=tracking.root, fix=fix)
    experiments = sorted(client(tracking).search_experiments(), key=lambda found: int(found.experiment_id))
    links = {
        experiment.name: f"{server}/{experiment_link(experiment.experiment_id, view)}"
        for experiment in experiments
        if (view := first_view(experiment.tags))
    }
    evaluations = {name: link for name, link in links.items() if "evaluation" in name}
    return evaluations | links or {"all runs": f"{server}/#/experiments"}


def _server_command(tracking: TrackingConfig, port: int) -> list[str]:
    """Return the command of MLflow's server; run by gunicorn it has no assistant."""
    gunicorn = "--timeout 120 --graceful-timeout 2 --log-level warning"
    options = ["--host", ADDRESS, "--port", str(port), "--workers", "2", "--gunicorn-opts", gunicorn]
    python = [sys.executable, "-W", "ignore", "-m"]
    return [*python, "mlflow", "server", *options, "--backend-store-uri", tracking.uri]


def _wait_for(server: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the server responds. Raises ConfigError if it ends or takes too long."""
    end = time.monotonic() + WAIT_S
    while server.poll() is None and time.monotonic() < end:
        try:
            connection = HTTPConnection(ADDRESS, port, timeout=WAIT_S)
            connection.request("GET", "/health")
            connection.getresponse().read()
            return
        except OSError:
            time.sleep(0.2)
    fix = "Its output is above; use another port or folder of runs."
    raise ConfigError("MLflow's server did not start", value=server.poll(), fix=fix)
