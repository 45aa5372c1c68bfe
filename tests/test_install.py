"""Base commands use no package of an extra, and commands that need one name its extra."""

import subprocess
import sys
import tomllib
from pathlib import Path

from wheretolook.utils.package import EXTRAS

ROOT = Path(__file__).parents[1]
BLOCKED = """
import sys
from wheretolook.utils.package import EXTRAS
from wheretolook.cli import main
sys.modules.update(dict.fromkeys(EXTRAS))
sys.exit(main(sys.argv[1:]))
"""


def ran(*arguments):
    """Run a command where no package of an extra can be imported."""
    return subprocess.run([sys.executable, "-c", BLOCKED, *arguments], capture_output=True, text=True)


def test_every_extra_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {*EXTRAS.values()} <= {*project["optional-dependencies"]}
    names = {"cv2": "opencv", "sklearn": "scikit-learn", "rerun": "rerun-sdk"}
    base = " ".join(project["dependencies"])
    for module, extra in EXTRAS.items():
        name = names.get(module, module)
        assert name not in base and any(name in one for one in project["optional-dependencies"][extra])


def test_base_modules_import_no_extra():
    modules = ("holdout.report", "view.server", "robot.export", "localization.localizer", "select.where_to_look")
    text = "import sys; from importlib import import_module; from wheretolook.utils.package import EXTRAS;"
    text += " sys.modules.update(dict.fromkeys(EXTRAS));"
    text += f" [import_module('wheretolook.' + name) for name in {modules}]"
    subprocess.run([sys.executable, "-c", text], check=True)


def test_commands_that_need_an_extra_name_it(tmp_path):
    (tmp_path / "images").mkdir()
    for name in "ab":
        (tmp_path / "images" / f"{name}.png").touch()
    done = ran("map", "--data", str(tmp_path), "--name", "x", "--images", str(tmp_path / "images"))
    assert done.returncode == 2 and "pip install 'wheretolook[photographs]'" in done.stderr, done.stderr
