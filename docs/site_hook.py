"""MkDocs hook: what the pages link to outside docs/ becomes part of the site, at the same place as in the repository.

Links stay as they are read in the repository, such as `../data/release/README.md`; Markdown found so is a page, and
what it links to is taken along too. The README is the site's home.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|[#/])([^)\s#]+)")


def _place(uri: str) -> str:
    """Return the path of a file of the repository, such as docs/stages.md, in the site's sources: stages.md."""
    return "index.md" if uri == "README.md" else uri.removeprefix("docs/")


def _taken(uri: str, config: MkDocsConfig) -> File:
    """Return a file of the repository outside docs/ as a file of the site."""
    return File(uri, str(ROOT), config.site_dir, config.use_directory_urls)


def _target(file: File, link: str) -> str:
    """The file of the repository that a page's link names."""
    page = Path(str(file.abs_src_path)).relative_to(ROOT).as_posix()
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


@event_priority(50)  # before the plugin that makes pages of notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Take along what is linked to outside docs/."""
    pages, named = list(files.documentation_pages()), _in_nav(config.nav)
    for uri in sorted(named - {file.src_uri for file in files}):
        if (ROOT / uri).is_file():
            pages.append(_taken(uri, config))
            files.append(pages[-1])
    while pages:
        page = pages.pop()
        for link in LINK.findall(Path(str(page.abs_src_path)).read_text(encoding="utf-8")):
            uri = _target(page, link)
            if files.get_file_from_path(_place(uri)) is None and (ROOT / uri).is_file():
                found = _taken(uri, config)
                files.append(found)
                if found.is_documentation_page():
                    pages.append(found)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links as they are read in the repository into the site's."""
    here = posixpath.dirname(page.file.src_uri)

    def moved(link: re.Match[str]) -> str:
        return posixpath.relpath(_place(_target(page.file, link[1])), here or ".")

    return LINK.sub(moved, markdown)


def _in_nav(items: object) -> set[str]:
    """Files that the navigation names."""
    if isinstance(items, dict):
        return {name for value in items.values() for name in _in_nav(value)}
    if isinstance(items, list):
        return {name for item in items for name in _in_nav(item)}
    return {str(items)}
