"""What stands at the top of the project: few files, which agree with the package and with each other."""

from __future__ import annotations

import re
import subprocess
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import yaml

from wheretolook.utils.version import VERSION

ROOT = Path(__file__).parents[1]
PROJECT = {"CITATION.cff", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"}


@pytest.fixture(scope="module")
def citation() -> dict[str, Any]:
    return dict(yaml.safe_load((ROOT / "CITATION.cff").read_text()))


def test_the_top_level_holds_nothing_else() -> None:
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files"], capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no checkout")
    top = {name.partition("/")[0] for name in listed.stdout.splitlines() if not name.startswith(".")}
    folders = {"notebooks", "src", "data", "configs", "mlruns", "tests", "docs"}
    files = {"environment.md", "pyproject.toml", "mkdocs.yml", "README.md", "LICENSE", "Makefile"}
    assert top - PROJECT == folders | files


def test_the_citation_has_what_its_schema_requires(citation: dict[str, Any]) -> None:
    """Citation File Format 1.2.0: the keys it requires of a software, a person, an entity and a reference."""
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    assert {"message", "title", "authors"} <= {*citation}
    known = {"cff-version", "message", "type", "title", "abstract", "version", "date-released", "license", "keywords",
             "authors", "references", "url", "repository-code", "identifiers", "preferred-citation", "doi",
             "contact", "commit", "license-url", "repository", "repository-artifact"}  # fmt: skip
    assert {*citation} <= known
    assert citation["version"] == VERSION
    assert date.fromisoformat(citation["date-released"])  # a string, as the schema has it, not YAML's date
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= {*paper} and paper["conference"]["name"]
    assert isinstance(paper["year"], int) and paper["url"].startswith("https://")
    for author in [*citation["authors"], *paper["authors"]]:
        assert {*author} in ({"name"}, {"family-names", "given-names", "orcid"})
    for author in paper["authors"]:
        digits = re.fullmatch(r"https://orcid\.org/(\d{4}-\d{4}-\d{4}-\d{3}[\dX])", author["orcid"])
        assert digits is not None and _check_digit(digits[1].replace("-", "")[:-1]) == digits[1][-1]


def _check_digit(digits: str) -> str:
    """Of an ORCID, ISO 7064 MOD 11-2."""
    total = 0
    for digit in digits:
        total = (total + int(digit)) * 2
    rest = (12 - total % 11) % 11
    return "X" if rest == 10 else str(rest)


def test_the_paper_is_the_readmes(citation: dict[str, Any]) -> None:
    assert citation["references"][0]["title"] in " ".join((ROOT / "README.md").read_text().split())


def test_the_changelog_begins_with_this_version(citation: dict[str, Any]) -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    entries = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\S+)$", text, re.MULTILINE)
    assert entries[0] == (VERSION, citation["date-released"])
    numbers = [tuple(map(int, version.split("."))) for version, _ in entries]
    assert numbers == sorted(numbers, reverse=True) and numbers[-1] == (0, 1, 0)
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert {*re.findall(r"^### (\S+)$", text, re.MULTILINE)} <= kinds
    assert ".".join(VERSION.split(".")[:2]) in (ROOT / "SECURITY.md").read_text()


def test_links_to_files_lead_somewhere() -> None:
    for name in sorted(PROJECT - {"CITATION.cff"}):
        for target in re.findall(r"\]\(([^)]+)\)", (ROOT / name).read_text()):
            assert target.startswith("https://") or (ROOT / target).exists(), f"{name}: {target}"


def test_the_package_says_whose_it_is(citation: dict[str, Any]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == citation["license"] == "Apache-2.0"
    assert project["urls"]["The paper"] == citation["references"][0]["url"]
    assert all(url.startswith("https://") for url in project["urls"].values())
