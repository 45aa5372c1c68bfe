"""Versions of the packages that labels depend on."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version

from wheretolook.utils.version import VERSION


@cache
def versions() -> dict[str, str]:
    """Versions of the packages that decide a label."""
    result = {"wheretolook": VERSION}
    for package in ("poselib", "pycolmap", "opencv-python-headless", "warp-lang", "numpy", "torch"):
        try:
            result[package] = version(package)
        except PackageNotFoundError:  # installed some other way
            result[package] = "unknown"
    return result
