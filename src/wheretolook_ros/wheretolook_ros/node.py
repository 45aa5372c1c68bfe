"""What the nodes share: the robot's folder, diagnostics, and a clean shutdown."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from wheretolook_ros.head import Head

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PARAMETERS: dict[str, Any] = {
    "folder": "robot",
    "map_frame": "map",
    "base_frame": "base_link",
    "mount": [0.0, 0.0, 1.2, 0.0, 0.0, 0.0],
    "pan_joint": "",
    "tilt_joint": "",
    "pan_limits_deg": [-180.0, 180.0],
    "tilt_limits_deg": [-45.0, 45.0],
}
"""Parameters of all nodes, see config/wheretolook.yaml."""


class RobotNode(Node):
    """A node with parameters, a camera on a head, and diagnostics."""

    def __init__(self, name: str, parameters: dict[str, Any]) -> None:
        super().__init__(name)
        declared = self.declare_parameters("", [*(PARAMETERS | parameters).items()])
        self.settings = {parameter.name: parameter.value for parameter in declared}
        limits = tuple(self.settings["pan_limits_deg"]), tuple(self.settings["tilt_limits_deg"])
        self.head = Head(tuple(self.settings["mount"]), *limits)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._reported = (OK, "")

    def load(self, *modules: str) -> list[Any] | None:
        """Import modules from the robot's folder; report what is wrong and return None if that fails."""
        folder = Path(self.settings["folder"]).absolute()
        sys.path.insert(0, str(folder))
        try:
            for name in ("robot.json", *(module.split(".")[0] for module in modules)):
                if not [*folder.glob(f"{name}*")]:
                    raise FileNotFoundError(f"{folder / name}: no such file. Export with --localize.")
            return [import_module(module) for module in modules]
        except Exception as error:  # code of another version fails in any way
            self.report(ERROR, f"the robot's folder cannot be used: {error}")
            return None

    def report(self, level: bytes, message: str, **values: object) -> None:
        """Publish diagnostics, and log a message that differs from the last one."""
        if (level, message) != self._reported and (level != OK or self._reported[0] != OK):
            log = self.get_logger()
            if level == OK:
                log.info(message)
            elif level == WARN:
                log.warning(message)
            else:
                log.error(message)
        self._reported = level, message
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        name = f"{self.get_name()}: {self.settings['map_frame']}"
        status = DiagnosticStatus(level=level, name=name, message=message, hardware_id="camera", values=pairs)
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def run(node: type[Node]) -> None:
    """Run a node until it is interrupted or terminated."""
    rclpy.init()
    try:
        rclpy.spin(node())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():  # not because of a signal while a callback runs
            raise
    finally:
        rclpy.try_shutdown()
