"""What the nodes share: the robot's folder, diagnostics, and a clean shutdown."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from wheretolook_ros.head import Head

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
DEFAULTS = Path(__file__).with_name("wheretolook.yaml")


class RobotNode(Node):
    """A node with parameters, a camera on a head, and diagnostics."""

    def __init__(self, name: str, more: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Declare the parameters of `DEFAULTS` for all nodes and for this one, and `more`."""
        super().__init__(name)
        stored = yaml.safe_load(DEFAULTS.read_text(encoding="utf-8"))
        known = [stored.get(owner, {}).get("ros__parameters", {}) for owner in ("/**", name)]
        declared = self.declare_parameters("", [item for part in (*known, more) for item in part.items()])
        self.settings = {parameter.name: parameter.value for parameter in declared}
        self.joint_names = [self.settings["pan_joint"], self.settings["tilt_joint"]]
        limits = tuple(self.settings["pan_limits_deg"]), tuple(self.settings["tilt_limits_deg"])
        self.head = Head(tuple(self.settings["mount"]), *limits)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.reported = (OK, "")

    def open_folder(self, use: Callable[..., None], *modules: str) -> bool:
        """Call a function with modules of the robot's folder; report why, and return False, if that fails."""
        folder = Path(self.settings["folder"]).absolute()
        sys.path.insert(0, str(folder))
        try:
            if not (folder / "robot.json").is_file():
                raise FileNotFoundError("robot.json is missing. Export with --localize")
            use(*map(import_module, modules))
        except Exception as error:  # code of another version fails in any way
            self.report(ERROR, f"the robot's folder {folder} cannot be used: {error}")
            return False
        return True

    def check_frame(self, message: Any, setting: str) -> None:
        """Raise ValueError unless a message is in the frame that a parameter names."""
        if message.header.frame_id != self.settings[setting]:
            raise ValueError(f"its frame is {message.header.frame_id!r}, not {self.settings[setting]!r}")

    def report(self, level: bytes, message: str, **values: object) -> None:
        """Publish diagnostics, and log a message that differs from the last one."""
        if (level, message) != self.reported:
            log = self.get_logger()
            if level == OK:
                log.info(message)
            else:
                log.error(message)
        self.reported = level, message
        status = DiagnosticStatus(level=level, name=self.get_name(), message=message)
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def run(node: Callable[[], Node]) -> None:
    """Run a node until it is interrupted or terminated."""
    rclpy.init()
    try:
        started = node()
        while rclpy.ok():  # with a limit, since a signal does not always end a wait
            rclpy.spin_once(started, timeout_sec=1)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except InvalidParameterTypeException as error:
        sys.exit(str(error))
    except Exception:
        if rclpy.ok():  # not because of a signal while a callback runs
            raise
    finally:
        rclpy.try_shutdown()
