"""Launches both nodes: ros2 launch wheretolook_ros wheretolook.launch.py folder:=robot"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return a description with the arguments `folder`, `params_file` and `use_sim_time`."""
    share = Path(get_package_share_directory("wheretolook_ros"))
    defaults = {"folder": "robot", "params_file": str(share / "config" / "wheretolook.yaml"), "use_sim_time": "false"}
    given = {name: LaunchConfiguration(name) for name in defaults}
    overrides = {name: given[name] for name in ("folder", "use_sim_time")}
    nodes = [
        Node(package="wheretolook_ros", executable=executable, name=name, parameters=[given["params_file"], overrides])
        for executable, name in (("localizer", "visual_localization"), ("gaze", "gaze"))
    ]
    arguments = [DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()]
    return LaunchDescription([*arguments, *nodes])
