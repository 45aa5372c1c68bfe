"""Builds the package by colcon; pip installs it with the rest of the repository: `pip install '.[ros]'`."""

from setuptools import setup

NAME = "wheretolook_ros"

setup(
    name=NAME,
    version="0.3.0",
    packages=[NAME],
    package_data={NAME: ["wheretolook.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", [f"{NAME}/wheretolook.yaml"]),
        (f"share/{NAME}/launch", ["launch/wheretolook.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    license="Apache-2.0",
    entry_points={"console_scripts": [f"localizer = {NAME}.localizer:main", f"gaze = {NAME}.gaze:main"]},
)
