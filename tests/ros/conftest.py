"""The folder of a room for the nodes, and a context of ROS for each module."""

import os

import pytest


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    from ros.room import room_mesh, write_folder

    return write_folder(room_mesh(), tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def context():
    import rclpy

    from ros.processes import environment

    os.environ.update(environment())
    rclpy.init()
    yield
    rclpy.try_shutdown()
