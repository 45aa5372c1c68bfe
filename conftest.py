"""Keeps tests apart from the checkout and its user: each has an empty working folder and a home, and no file changes."""

from __future__ import annotations

import atexit
import os
import shutil
import site
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parent
WATCHED = ("configs", "data", "docs", "mlruns", "notebooks", "src", "tests")
"""Folders in which, as beside them, no test may add, remove or change a file."""

OF_THE_USER = ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "WHERETOLOOK_RELEASE")


def use_other_home() -> None:
    """Set HOME to an empty temporary folder, before anything that reads it is imported.

    Processes that this one starts inherit it. What is slow to make is shared by all of them: Matplotlib's list of fonts,
    and Warp's compiled kernels, which outlast the session.
    """
    home = tempfile.mkdtemp(prefix="wheretolook-tests-")
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    kernels = ROOT / ".pytest_cache" / "warp"
    if not os.access(ROOT, os.W_OK):
        kernels = Path(home, "warp")
    os.environ.setdefault("PYTHONUSERBASE", site.getuserbase())  # packages that are installed there
    os.environ.setdefault("WARP_CACHE_PATH", str(kernels))
    os.environ["MPLCONFIGDIR"] = str(Path(home, "matplotlib"))
    for name in OF_THE_USER:
        os.environ.pop(name, None)
    os.environ["HOME"] = home


IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ
if not IS_WORKER:  # workers of pytest-xdist inherit what the process that starts them has set
    use_other_home()

CHECKOUT = pytest.StashKey[dict[str, tuple[int, int]]]()


def checkout_files() -> dict[str, tuple[int, int]]:
    """Return time of change and size of each file of the checkout, and (0, 0) for folders; of others, only their names.

    Bytecode, hidden folders, and hidden files beside the folders are left out.
    """
    beside = [path for path in ROOT.iterdir() if path.name != "__pycache__" and not path.name.startswith(".")]
    found = {path.name: (0, 0) for path in beside}
    paths = [path for path in beside if path.is_file()]
    for folder in WATCHED:
        for where, folders, files in os.walk(ROOT / folder):
            folders[:] = [name for name in folders if name != "__pycache__" and not name.startswith(".")]
            found |= {os.path.relpath(os.path.join(where, name), ROOT): (0, 0) for name in folders}
            paths += [Path(where, name) for name in files]
    for path in paths:
        with suppress(FileNotFoundError):  # such as a lock that another process has released
            status = path.lstat()
            found[str(path.relative_to(ROOT))] = (status.st_mtime_ns, status.st_size)
    return found


def pytest_sessionstart(session: pytest.Session) -> None:
    if not IS_WORKER:
        session.config.stash[CHECKOUT] = checkout_files()


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    if IS_WORKER:
        return
    before, after = session.config.stash[CHECKOUT], checkout_files()
    changed = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
    if changed:
        text = f"Files of the checkout have changed since the tests began: {', '.join(changed[:10])}"
        session.config.get_terminal_writer().line(f"\n{text}", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def empty_folders() -> Iterator[None]:
    """Run in an empty working folder with an empty home beside it."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, pytest.MonkeyPatch.context() as patch:
        for name in ("home", "work"):
            os.mkdir(os.path.join(folder, name))
        patch.setenv("HOME", os.path.join(folder, "home"))
        patch.chdir(os.path.join(folder, "work"))
        yield


for_fixtures = pytest.fixture(empty_folders, scope="session", autouse=True, name="empty_folders_of_fixtures")
for_a_test = pytest.fixture(empty_folders, autouse=True, name="empty_folders")
