"""The folder of a room for the nodes, and a context of ROS for each module."""

import os

import pytest


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Write the robot's folder; its code, which is for others than the nodes, ends any process that imports it."""
    from ros.room import room_mesh, write_folder

    written = write_folder(room_mesh(), tmp_path_factory.mktemp("room"))
    for name in ("wheretolook_robot.py", "wheretolook_localization/__init__.py", "wheretolook.py", "yaml.py"):
        (written / name).write_text("import os\nos._exit(9)\n")
    return written


@pytest.fixture(scope="module")
def context():
    import rclpy

    from ros.processes import environment

    os.environ.update(environment())
    rclpy.init()
    yield
    rclpy.try_shutdown()
