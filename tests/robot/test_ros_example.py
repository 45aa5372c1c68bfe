"""The ROS 2 example, which no test runs: it parses, and what it uses of wheretolook_robot.py is there."""

from __future__ import annotations

import ast
import dataclasses
import inspect
from pathlib import Path

from wheretolook.robot import wheretolook_robot
from wheretolook.robot.wheretolook_robot import BestView, RobotScorer

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "ros2_view_direction.py"


def nodes(tree: ast.AST, kind: type) -> list:
    return [node for node in ast.walk(tree) if isinstance(node, kind)]


def test_it_uses_what_there_is() -> None:
    tree = ast.parse(EXAMPLE.read_text(encoding="utf-8"))
    assert "not run" in (ast.get_docstring(tree) or "")
    imports = {str(node.module): [alias.name for alias in node.names] for node in nodes(tree, ast.ImportFrom)}
    assert imports["wheretolook_robot"]
    assert all(hasattr(wheretolook_robot, name) for name in imports["wheretolook_robot"])
    assert {*imports} == {"wheretolook_robot", "geometry_msgs.msg", "rclpy.node"}

    of_view = {node.attr for node in nodes(tree, ast.Attribute) if ast.unparse(node.value) == "view"}
    assert of_view and of_view <= {field.name for field in dataclasses.fields(BestView)}
    of_scorer = {node.attr for node in nodes(tree, ast.Attribute) if ast.unparse(node.value) == "self.scorer"}
    assert of_scorer == {"best"}
    (call,) = [node for node in nodes(tree, ast.Call) if ast.unparse(node.func) == "self.scorer.best"]
    inspect.signature(RobotScorer.best).bind("self", *call.args, **{word.arg: word.value for word in call.keywords})
    (call,) = [node for node in nodes(tree, ast.Call) if ast.unparse(node.func) == "RobotScorer"]
    inspect.signature(RobotScorer).bind(*call.args, **{word.arg: word.value for word in call.keywords})


def test_what_it_publishes_and_hears_is_what_it_says() -> None:
    tree = ast.parse(EXAMPLE.read_text(encoding="utf-8"))
    text = ast.get_docstring(tree) or ""
    topics = {node.value for node in nodes(tree, ast.Constant) if str(node.value).startswith("~/")}
    assert topics == {"~/pose", "~/view", "~/direction"}
    calls = [node for node in nodes(tree, ast.Call) if ast.unparse(node.func) == "self.declare_parameter"]
    parameters = {call.args[0].value for call in calls}
    assert parameters == {"frame", "folder", "directions", "min_pitch_deg", "max_pitch_deg", "min_score"}
    assert all(f"`{name}`" in text for name in parameters) and all(topic in text for topic in topics)
    # attributes of the node that are read are set
    used = {node.attr for node in nodes(tree, ast.Attribute) if ast.unparse(node.value) == "self"}
    known = {node.attr for node in nodes(tree, ast.Attribute) if isinstance(node.ctx, ast.Store)}
    known |= {node.name for node in nodes(tree, ast.FunctionDef)}
    of_rclpy = {"declare_parameter", "create_publisher", "create_subscription", "get_logger"}
    assert used - known == of_rclpy
