"""What the nodes share: parameters, the robot's folder, diagnostics, and a clean shutdown."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from wheretolook_ros.head import Head

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
DEFAULTS = Path(__file__).with_name("wheretolook.yaml")
STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # of timers: a simulated clock may stand still

LIMITS = "[lowest, highest] in degrees", lambda value: len(value) == 2 and -180 <= value[0] <= value[1] <= 180
ALLOWED = {
    "mount": ("six finite numbers", lambda value: len(value) == 6 and np.isfinite(value).all()),
    "pan_limits_deg": LIMITS,
    "tilt_limits_deg": LIMITS,
    "image_qos": ("sensor_data or system_default", lambda value: value in ("sensor_data", "system_default")),
    "confidence": ("above 0 and at most 1", lambda value: 0 < value <= 1),
}
OTHERS = "positive and finite", lambda value: isinstance(value, str | bool) or 0 < value < np.inf


class RobotNode(Node):
    """A node with parameters, a camera on a head, and diagnostics."""

    def __init__(self, name: str) -> None:
        """Declare the parameters of `DEFAULTS` for all nodes and for this one; exit if a value is not allowed."""
        super().__init__(name)
        stored = yaml.safe_load(DEFAULTS.read_text(encoding="utf-8"))
        defaults = stored["/**"]["ros__parameters"] | stored.get(name, {}).get("ros__parameters", {})
        given = {known.name: known.value for known in self.declare_parameters("", [*defaults.items()])}
        for parameter, value in given.items():
            rule, accepts = ALLOWED.get(parameter, OTHERS)
            if value is None or not accepts(value):  # None for an empty list
                sys.exit(f"parameter {parameter} is {np.array(value)}; it must be {rule}")
        self.settings = SimpleNamespace(**given)
        self.joint_names = [self.settings.pan_joint, self.settings.tilt_joint]
        limits = [self.settings.pan_limits_deg, self.settings.tilt_limits_deg]
        if any(self.joint_names):  # the other one does not move if it is missing
            both = zip(self.joint_names, limits, strict=True)
            limits = [pair if joint else [np.clip(0, *pair)] * 2 for joint, pair in both]
        self.head = Head(self.settings.mount, *limits)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.reported = (OK, "")

    def open_folder(self, use: Callable[[Path], None]) -> bool:
        """Call a function with the robot's folder; if that fails, report why from now on, return False."""
        folder = Path(self.settings.folder).absolute()
        try:
            use(folder)
        except Exception as error:  # whatever a folder of another version holds
            self.report(ERROR, f"cannot load {folder} as a folder of `wheretolook export --localize`: {error}")
            self.create_timer(1.0, lambda: self.report(*self.reported), clock=STEADY)
            return False
        self.get_logger().info(f"loaded {folder}")
        return True

    def listen(self, kind: Any, topic: str, use: Callable[[Any], None], qos: Any = 10) -> None:
        """Call a function with each message of a topic; report it if that fails."""

        def received(message: Any) -> None:
            try:
                use(message)
            except Exception as error:  # whatever a message holds, and whatever the folder's modules raise
                self.report(WARN, f"{topic}: {error}")

        self.create_subscription(kind, topic, received, qos)

    def check_frame(self, message: Any, setting: str) -> None:
        """Raise ValueError unless a message is in the frame that a parameter names."""
        expected = getattr(self.settings, setting)
        if message.header.frame_id != expected:
            raise ValueError(f"frame is {message.header.frame_id!r}, expected {expected!r}")

    def report(self, level: bytes, message: str, **values: object) -> None:
        """Publish diagnostics, and log a message that differs from the last one."""
        if (level, message) != self.reported:
            log = self.get_logger()
            if level == OK:  # a line of code logs at one severity only
                log.info(message)
            elif level == WARN:
                log.warning(message)
            else:
                log.error(message)
        self.reported = level, message
        status = DiagnosticStatus(level=level, name=self.get_name(), message=message)
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def run(node: Callable[[], Node]) -> None:
    """Run a node until it is interrupted or terminated; exit with one line if its parameters cannot be used."""
    try:
        rclpy.init()
    except RuntimeError as error:  # of rcl, such as for a list of mixed types
        sys.exit(str(error))
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
