"""The ROS 2 example, which needs ROS to run, uses names that exist in wheretolook_robot.py."""

from __future__ import annotations

import ast
import dataclasses
import inspect
from pathlib import Path

from wheretolook.robot import wheretolook_robot
from wheretolook.robot.wheretolook_robot import BestView, RobotScorer

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "ros2_view_direction.py"


def test_names_and_arguments_exist() -> None:
    nodes = [*ast.walk(ast.parse(EXAMPLE.read_text(encoding="utf-8")))]
    imports = {node.module: node.names for node in nodes if isinstance(node, ast.ImportFrom)}
    assert all(hasattr(wheretolook_robot, alias.name) for alias in imports["wheretolook_robot"])
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    of_view = {node.attr for node in attributes if ast.unparse(node.value) == "view"}
    assert of_view and of_view <= {field.name for field in dataclasses.fields(BestView)}
    calls = {ast.unparse(node.func): node for node in nodes if isinstance(node, ast.Call)}
    for name, function in (("self.scorer.best", RobotScorer.best), ("RobotScorer", RobotScorer.__init__)):
        call = calls[name]
        inspect.signature(function).bind("self", *call.args, **{str(word.arg): word.value for word in call.keywords})
