"""The documentation: it builds without a warning, its code runs, its commands are real, its numbers the release's."""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import wheretolook
from box_scenes import furnished_room
from selection.room import write_room
from wheretolook.cli import COMMANDS, command_options, command_targets, load_command, main, parse_command
from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.colmap_model import colmap_poses
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import save_glb
from wheretolook.utils import errors
from wheretolook_paper.figures.paths import photograph_paths_markdown, read_photograph_paths
from wheretolook_paper.release.numbers import Numbers, pages, updated

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [path.name for path in PAGES]

NOT_RUN = r"(?:<!-- not run: (?P<why>[^\n]+) -->\n)?"
BLOCK = re.compile(NOT_RUN + r"^```(?P<language>\w*)\n(?P<code>.*?)^```$", re.M | re.S)
CHECKED = ("python", "sh")  # in these languages; in others, such as text and toml, there is nothing to run


def blocks(page, language):
    """Blocks of code of a page in a language, but for those that say why they are not run."""
    found = list(BLOCK.finditer(page.read_text()))
    return [block["code"] for block in found if block["language"] == language and block["why"] is None]


# --- the site


@pytest.mark.skipif(find_spec("mkdocs") is None, reason="mkdocs is not installed: pip install '.[docs]'")
def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "site"
    for page in (ROOT / "docs").glob("*.md"):
        assert (site / ("" if page.stem == "index" else page.stem) / "index.html").is_file(), page
    home = (site / "index.html").read_text()
    (picture,) = re.findall(r'<img[^>]*src="([^"]*pipeline\.webp)"', home)
    assert (site / picture).read_bytes() == (ROOT / "notebooks" / "images" / "pipeline.webp").read_bytes()
    assert "WhereToLook" in (site / "api" / "index.html").read_text()
    assert (site / "data" / "release" / "index.html").is_file()  # linked to, and so taken along


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_to_files_and_headings(page):
    links = re.findall(r"\]\((?!https?:|mailto:)([^)\s#]*)(?:#([^)\s]+))?\)", page.read_text())
    for target, heading in links:
        path = page.parent / target if target else page
        assert path.is_file(), f"{page.name}: {target}"
        if heading:
            texts = re.findall(r"^#+ (.*)$", path.read_text(), re.M)
            slugs = [re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower()) for text in texts]
            assert heading in slugs, f"{page.name}: {target}#{heading}"


# --- Python blocks: they run on a room of boxes and the bundled weights


@pytest.fixture(scope="module")
def users_folder(tmp_path_factory):
    """Return a folder with what the pages expect: a model, a mesh, depth images, waypoints, the release."""
    folder = tmp_path_factory.mktemp("user")
    mesh = furnished_room()
    save_glb(mesh, folder / "scan.glb")
    model = write_room(folder / "sparse" / "0")
    (folder / "depth").mkdir()
    depths = WarpRenderer(mesh).render(PinholeCamera(320, 240, 160.0), colmap_poses(model)).depth_m
    for row, depth in enumerate(depths):
        np.save(folder / "depth" / f"{row:03}.npy", depth)
    (folder / "waypoints.csv").write_text("x,y,z\n2.0,2.0,1.5\n2.5,2.0,1.5\n")
    (folder / "data").mkdir()
    (folder / "data" / "release").symlink_to(ROOT / "data" / "release")
    return folder


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name)
def test_python_blocks_run(page, users_folder, tmp_path, monkeypatch):
    shutil.copytree(users_folder, tmp_path / "user", symlinks=True)
    monkeypatch.chdir(tmp_path / "user")
    names = {"__name__": page.stem}
    for code in blocks(page, "python"):
        exec(compile(code, str(page), "exec"), names)  # blocks of a page build on one another
    if page.name in ("README.md", "quickstart.md"):
        assert len(code.strip().splitlines()) <= 10
        rows = pd.read_csv("views.csv")
        assert len(rows) == 2 and rows["score"].between(0, 1).all()


# --- shell blocks: options are real


def commands(page):
    """Commands of a page's shell blocks, without comments and settings of the environment."""
    found = []
    for code in blocks(page, "sh"):
        for line in code.replace("\\\n", " ").splitlines():
            lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;")
            lexer.whitespace_split = True
            words = []
            for word in [*lexer, ";"]:
                if set(word) <= set("&|;"):
                    found.append(words)
                    words = []
                elif words or not re.match(r"\w+=", word):
                    words.append(word)
    return [words for words in found if words]


def check_wheretolook(arguments):
    """Raise, or fail, if there is no such command or option."""
    command, *rest = arguments
    if {"--help", "--list", "--list-methods"} & {*rest}:
        assert main(arguments) == 0
    else:
        parse_command(command, [word for word in rest if word != "--print_config"])


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "sh")], ids=lambda page: page.name)
def test_shell_blocks_name_real_commands(page):
    Path("data").mkdir()
    Path("data", "release").symlink_to(ROOT / "data" / "release")
    makefile = (ROOT / "Makefile").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for words in commands(page):
        program, *rest = words
        if program == "wheretolook":
            check_wheretolook(rest)
        elif program == "make":
            assert [word for word in rest if "=" not in word and f"\n{word}: " not in makefile] == []
        elif program == "pip" and rest[0] == "install":
            extras = re.findall(r"\[(.*)\]", " ".join(rest))
            assert {name for extra in extras for name in extra.split(",")} <= {*project["optional-dependencies"]}
        elif program == "python":
            assert (ROOT / rest[0]).is_file(), rest[0]
        else:
            pytest.fail(f"{page.name}: say why this is not run: {' '.join(words)}")


# --- numbers: those of the release's tables


NUMBERS = Numbers(ROOT)


@pytest.mark.parametrize("page", pages(NUMBERS))
def test_numbers_are_those_of_the_results(page):
    assert (ROOT / page).read_text() == updated(page, NUMBERS), (
        "python -m wheretolook_paper.studies.results --only '[pages]'"
    )


def test_a_changed_result_changes_the_page(tmp_path):
    shutil.copytree(ROOT / "data" / "release" / "results", tmp_path / "data" / "release" / "results")
    shutil.copy(ROOT / "data" / "release" / "README.md", tmp_path / "data" / "release")
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    path = tmp_path / "data" / "release" / "results" / "looks.csv"
    table = pd.read_csv(path)
    table.loc[(table["split"] == "test") & (table["n_looks"] == 2), "good"] = 0.123
    table.to_csv(path, index=False)
    text = updated("docs/looks.md", Numbers(tmp_path))
    assert text.count("| 12.3 |") == 7 and text != (ROOT / "docs" / "looks.md").read_text()


def test_the_table_of_paths_on_photographs_is_that_of_the_release():
    table, landmarks = read_photograph_paths(Dataset.load(ROOT / "data" / "release"))
    page, made = (
        [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if line[:2] == "| "]
        for text in ((ROOT / "docs" / "results.md").read_text(), photograph_paths_markdown(table))
    )
    missing = [cells for cells in made if cells not in page and set(cells[1]) != {"-"}]
    assert len(made) == 8 and not missing
    assert set(landmarks["scene"]) == set(table["scene"])


# --- options


def test_options_are_few_and_each_is_in_a_page_configuration_or_notebook():
    sources = [*PAGES, *(ROOT / "docs" / "research").glob("*.md"), *(ROOT / "notebooks").glob("*.py")]
    text = "\n".join(path.read_text() for path in sources)
    configured = {
        name for path in (ROOT / "configs").glob("*.yaml") for name in dotted(yaml.safe_load(path.read_text()))
    }
    options = {}
    for command in map(load_command, command_targets()):
        for name in command_options(command):
            options.setdefault(name, {name}).update(short for short, full in command.SHORT.items() if full == name)
    missing = []
    for option, names in options.items():
        written = [rf"--{re.escape(name).replace('_', '[-_]')}(?![\w.-])" for name in names]
        written += [rf"(?<![\w.-]){re.escape(name)}(?!\w)" for name in names if "." in name]
        if option not in configured and not re.search("|".join(written), text):
            missing.append(option)
    assert missing == [] and len(options) <= 185


def dotted(settings, prefix=""):
    """Yield the dotted names of nested settings."""
    for key, value in settings.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")


# --- the public names


def test_the_page_of_the_interface_lists_what_is_public():
    documented = set()
    commands = set()
    for name, options in re.findall(
        r"^::: ([\w.]+)\n((?:    .*\n)*)", (ROOT / "docs" / "api.md").read_text() + "\n", re.M
    ):
        members = re.search(r"members: \[(.*)\]", options)
        if name == "wheretolook.utils.errors":
            documented |= {
                known
                for known, value in vars(errors).items()
                if isinstance(value, type) and issubclass(value, Exception)
            }
        elif name.startswith("wheretolook.commands."):
            commands.add(name)
        else:
            documented |= set(members[1].split(", ")) if members else {name.rpartition(".")[2]}
    assert documented == set(wheretolook.__all__) - {"__version__"}
    assert commands == {target.replace(":", ".") for target in COMMANDS.values()}
    home = {name: getattr(wheretolook, name).__module__ for name in documented}
    assert all(home[name] == wheretolook._HOMES[name] for name in documented), home
