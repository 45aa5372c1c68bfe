"""Recipes and manifests of other packagers name what pyproject.toml does."""

import ast
import re
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import yaml

from wheretolook.utils.package import VERSION

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ROS = ROOT / "src" / "wheretolook_ros"
CONDA = {"torch": "pytorch", "matplotlib": "matplotlib-base"}  # where names differ
ROSDEP = {
    "python3-numpy": "numpy",
    "python3-scipy": "scipy",
    "python3-opencv": "cv2",
    "python3-pil": "PIL",
    "python3-yaml": "yaml",
}
"""Modules by the rosdep key that installs them."""


def test_the_recipe_for_conda_has_the_same_requirements():
    recipe = yaml.safe_load((ROOT / "docs" / "packaging" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == VERSION and recipe["about"]["license"] == PROJECT["license"]
    (entry,) = recipe["build"]["python"]["entry_points"]
    assert dict([entry.split(" = ")]) == PROJECT["scripts"]
    python, *run = recipe["requirements"]["run"]
    bounds = python.removeprefix("python ").replace("${{ python_min }}", recipe["context"]["python_min"])
    assert bounds == PROJECT["requires-python"]
    needed = set()
    for requirement in PROJECT["dependencies"]:
        name, bound = re.fullmatch(r"([\w-]+)(?:\[\w+\])?(>=.*)", requirement).groups()
        needed.add(f"{CONDA.get(name, name)} {bound}")
    assert needed | {"docstring_parser", "typeshed-client"} == {*run}


def test_the_manifest_for_rosdep_has_what_the_nodes_import():
    manifest = ElementTree.parse(ROS / "package.xml").getroot()
    assert manifest.findtext("version") == VERSION and manifest.findtext("license") == PROJECT["license"]
    assert f'version="{VERSION}"' in (ROS / "setup.py").read_text()
    keys = {depend.text for depend in manifest.iter("exec_depend")}
    imported = set()
    for path in [*(ROS / "wheretolook_ros").glob("*.py"), *(ROS / "launch").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module.partition(".")[0])
    # the project itself comes by pip (docs/robots.md), launch and ament with launch_ros
    imported -= {"wheretolook", "wheretolook_ros", "launch", "ament_index_python", *sys.stdlib_module_names}
    assert {ROSDEP.get(key, key) for key in keys} == imported


def test_the_extra_for_ros_has_the_packages_of_the_manifest():
    manifest = ElementTree.parse(ROS / "package.xml").getroot()
    keys = {depend.text for depend in manifest.iter("exec_depend")}
    wheels = {re.match(r"ros-([\w-]+)", name)[1].replace("-", "_") for name in PROJECT["optional-dependencies"]["ros"]
              if name.startswith("ros-")}  # fmt: skip
    without_wheel = {"tf2_msgs", "launch_ros", "builtin_interfaces"}  # the last comes with others
    of_tests = {"rmw_fastrtps_cpp", "rosgraph_msgs"}
    assert wheels - of_tests == keys - {*ROSDEP} - without_wheel
