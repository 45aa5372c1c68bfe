"""`wheretolook ui`: links to comparisons, and MLflow's server without its assistant."""

import signal
import socket
import subprocess
import sys
from http.client import HTTPConnection

import pytest

from wheretolook.tracking import TrackingConfig, client, experiment_id
from wheretolook.utils.errors import InUseError, MissingRunError
from wheretolook_paper.commands.ui import Ui, comparisons


@pytest.fixture
def tracking(tmp_path):
    return TrackingConfig(str(tmp_path / "mlruns"))


def test_evaluations_are_compared_first(tracking):
    with pytest.raises(MissingRunError):
        comparisons(tracking, "")
    assert not tracking.root.exists()
    ids = {"label": experiment_id(client(tracking), tracking, "label", "house")}
    assert [*comparisons(tracking, "http://server").values()] == ["http://server/#/experiments"]
    for stage in ("paths", "evaluate"):
        ids[stage] = experiment_id(client(tracking), tracking, stage, "house")
    links = comparisons(tracking, "http://server")
    assert list(links) == ["house: evaluation", "house: paths"]
    view = "workflowType=machine_learning&viewStateShareKey=methods"
    assert links["house: evaluation"] == f"http://server/#/experiments/{ids['evaluate']}/runs?{view}"


def test_a_port_in_use():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(InUseError):
        Ui(port=taken.getsockname()[1]).run()


@pytest.mark.slow
def test_the_server_has_no_assistant_and_ends_when_interrupted(tracking):
    experiment_id(client(tracking), tracking, "evaluate", "house")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = ["--tracking.folder", tracking.folder, "--port", str(port)]
    command = [sys.executable, "-m", "wheretolook", "ui", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")
        assert any(f"http://mlflow.localhost:{port}/#/experiments/1/" in line for line in lines)
        statuses = {}
        for path in ("/", "/ajax-api/3.0/mlflow/assistant/config"):
            connection = HTTPConnection("127.0.0.1", port, timeout=60)
            connection.request("GET", path)
            statuses[path] = connection.getresponse().status
            connection.close()
        process.send_signal(signal.SIGINT)
    assert [*statuses.values()] == [200, 404]
