"""The suite is apart from the checkout and its user, and fails if a test has changed the checkout."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_home_and_working_folder_are_empty_and_inherited():
    code = "import os; print(os.listdir(), os.listdir(os.path.expanduser('~')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[] []\n"
    assert not Path.home().is_relative_to(ROOT) and not Path.cwd().is_relative_to(ROOT)
    Path("left_by_a_test").touch()
    Path("~/.left_by_a_test").expanduser().touch()


test_and_of_the_next_test = test_home_and_working_folder_are_empty_and_inherited


WRITING = """
import os
from pathlib import Path

DATA = Path(__file__).parents[1] / "data"

def test_writing():
    open("views.csv", "w")
    {code}
"""
CHANGES = """
    os.utime(DATA / "changed.txt")
    (DATA / "removed.txt").unlink()
    (DATA / "demo").mkdir()
    open(DATA.parent / "views.csv", "w")
    open(DATA.parent / "README.md", "a").write("more")
"""
CHANGED = "README.md, data/changed.txt, data/demo, data/removed.txt, views.csv"


@pytest.mark.parametrize(("code", "changed", "options"), [("", "", []), (CHANGES, CHANGED, ["-p", "xdist", "-n", "1"])])
def test_a_changed_checkout_fails_the_suite(code, changed, options, tmp_path):
    shutil.copy(ROOT / "conftest.py", tmp_path)
    for name in ("data", "tests"):
        (tmp_path / name).mkdir()
    for name in ("changed.txt", "removed.txt"):
        (tmp_path / "data" / name).touch()
    (tmp_path / "README.md").touch()
    (tmp_path / "tests" / "test_writing.py").write_text(WRITING.format(code=code))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    run = [sys.executable, "-m", "pytest", "-q", *options]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert "1 passed" in done.stdout and done.returncode == bool(changed)
    found = done.stdout.partition("Files of the checkout have changed since the tests began: ")[2]
    assert found.partition("\n")[0] == changed
