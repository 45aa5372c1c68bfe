"""Run notebooks and write each as one small HTML file with its pictures in it, and a first page that leads to them.

    python notebooks/pages.py notebooks notebooks/html

nbconvert's template alone weighs 600 kB a page; this one weighs two, and pictures are stored as WebP, no wider than
the page.
"""

from __future__ import annotations

import base64
import html
import io
import re
import sys
import time
from pathlib import Path
from typing import Any

from PIL import Image

_STYLE = """\
body { max-width: 80rem; margin: 0 auto; padding: 1.5rem 1rem; color: #333; font: 16px/1.5 system-ui, sans-serif }
a { color: #1a5fb4; text-decoration: none }
a:hover { text-decoration: underline }
h2 { scroll-margin-top: 1rem }
pre { padding: .5rem .8rem; overflow-x: auto; font-size: 13px; line-height: 1.4; background: #f6f8fa }
pre.output { background: none; border-left: 3px solid #ddd }
img { max-width: 100%; height: auto }
div.output { overflow: auto; max-height: 36rem; font-size: 12.5px }
div.output td, div.output th { padding: 2px 3px; font-size: 11.5px }
div.output th { position: sticky; top: 0; background: #fff }
ol.pages h2 { font-size: 1.15rem; margin: .4rem 0 }
ol.pages p { margin: 0 }
ol.pages { padding: 0; list-style: none; display: grid; gap: 1.5rem; \
grid-template-columns: repeat(auto-fill, minmax(min(20rem, 100%), 1fr)) }
ol.pages img { width: 100%; height: 12rem; object-fit: contain; object-position: left }
table { border-collapse: collapse; margin: .5rem 0 }
td, th { padding: 2px 8px; border-bottom: 1px solid #ddd; text-align: left }
div.page { display: grid; grid-template-columns: 15rem minmax(0, 1fr); gap: 2.5rem }
nav { font-size: 14px; line-height: 1.35 }
nav ol { list-style: none; margin: 0; padding: 0 }
nav li { margin: .45rem 0 }
nav li ol { margin: .3rem 0 .3rem .1rem; padding-left: .8rem; border-left: 2px solid #ddd }
nav [aria-current] { color: #333; font-weight: 600 }
nav summary { font-weight: 600; margin-bottom: .6rem; cursor: pointer }
nav.sequence { display: flex; justify-content: space-between; gap: 2rem; margin-top: 3rem; padding-top: 1rem; \
border-top: 1px solid #ddd }
@media (min-width: 60.01rem) { div.page > nav { position: sticky; top: 1.5rem; align-self: start; \
max-height: calc(100vh - 3rem); overflow-y: auto } }
@media (max-width: 60rem) { div.page { display: block } div.page > nav { border-bottom: 1px solid #ddd } }
@media (max-width: 40rem) { body { padding-top: 1rem; font-size: 15px } pre { font-size: 12px } }
"""

_NARROW = """\
<script>if (matchMedia("(max-width: 60rem)").matches) document.querySelector("nav details").open = false</script>"""

LARGE = 25_000
QUALITY = 55
WIDEST_PX = 960
"""Bytes above which a picture loses something, its quality then, and its width at most."""


def run_notebook(path: Path, timeout_s: float = 600) -> Any:
    """A notebook (`.ipynb`, or `.py` in jupytext's percent format) with its outputs, run in its own folder.

    Args:
        path: the notebook.
        timeout_s: for one cell.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails.
    """
    import jupytext
    from nbclient import NotebookClient

    notebook = jupytext.read(path)
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=timeout_s, kernel_name="python3", resources=resources).execute()
    return notebook


def notebook_page(notebook: Any, name: str = "", pages: dict[str, str] | None = None) -> str:
    """A notebook with outputs as an HTML page; the text of a picture is the first sentence of the cell before it.

    Args:
        notebook: as nbformat holds it.
        name: of the page, without `.html`.
        pages: titles of all pages of the folder, by their names, in their order.
    """
    from markdown_it import MarkdownIt
    from pygments import highlight
    from pygments.formatters import HtmlFormatter
    from pygments.lexers import PythonLexer

    markdown = MarkdownIt("commonmark").enable("table")
    formatter = HtmlFormatter(nobackground=True)
    body = []
    about = ""
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            body.append(_from_above(markdown.render(cell.source)))
            about = _first_sentence(cell.source)
        elif cell.cell_type == "code":
            body.append(highlight(cell.source, PythonLexer(), formatter))
            body += [_output(output, markdown, about) for output in cell.outputs]
    text, sections = _with_anchors("\n".join(body))
    titles = pages or {name: title_of(notebook)}
    main = ["<main>", text, _sequence(name, titles), "</main>"]
    body = ['<div class="page">', _contents(name, titles, sections), *main, "</div>"]
    return _page(title_of(notebook), formatter.get_style_defs(".highlight"), body)


def _with_anchors(body: str) -> tuple[str, dict[str, str]]:
    """Number the sections of a page; returns it and their headings (HTML) by their ids."""
    sections: dict[str, str] = {}

    def heading(found: re.Match[str]) -> str:
        section = f"section-{len(sections) + 1}"
        sections[section] = re.sub(r"<[^>]+>", "", found[1])
        return f'<h2 id="{section}">{found[1]}</h2>'

    return re.sub(r"<h2>(.*?)</h2>", heading, body), sections


def _contents(name: str, titles: dict[str, str], sections: dict[str, str]) -> str:
    """The list of all pages, with the sections of this one."""
    below = "".join(f'<li><a href="#{section}">{text}</a></li>' for section, text in sections.items())
    items = []
    for page, title in titles.items():
        here = ' aria-current="page"' if page == name else ""
        link = f'<a href="{page}.html"{here}>{html.escape(title)}</a>'
        items.append(f"<li>{link}{f'<ol>{below}</ol>' if below and here else ''}</li>")
    summary = '<summary><a href="index.html">Notebooks</a></summary>'
    return f"<nav><details open>{summary}<ol>{''.join(items)}</ol></details>{_NARROW}</nav>"


def _sequence(name: str, titles: dict[str, str]) -> str:
    """Links to the pages before and after this one."""
    names = [*titles]
    place = names.index(name)
    previous = names[place - 1] if place > 0 else "index"
    links = [f'<a href="{previous}.html" rel="prev">← {html.escape(titles.get(previous, "Notebooks"))}</a>']
    if place + 1 < len(names):
        links.append(f'<a href="{names[place + 1]}.html" rel="next">{html.escape(titles[names[place + 1]])} →</a>')
    return f'<nav class="sequence">{"".join(links)}</nav>'


def index_page(pages: dict[str, tuple[str, str, str]]) -> str:
    """The page that leads to the others: for each, by its name, its title, what it is about, and its first picture."""
    items = []
    for name, (title, about, picture) in pages.items():
        image = f'<a href="{name}.html"><img src="{picture}" alt="{html.escape(about)}"></a>' if picture else ""
        link = f'<a href="{name}.html">{html.escape(title)}</a>'
        items.append(f"<li>{image}<h2>{link}</h2><p>{html.escape(about)}</p></li>")
    lead = "What was measured, with the code that draws it: each page is a notebook of this folder with its outputs."
    return _page(
        "wheretolook: notebooks", "", ["<h1>Notebooks</h1>", f"<p>{lead}</p>", '<ol class="pages">', *items, "</ol>"]
    )


def title_of(notebook: Any) -> str:
    """The first heading of a notebook."""
    found = re.search(r"^# +(.+)$", "\n".join(_texts(notebook)), re.MULTILINE)
    return found[1].strip() if found else ""


def about_of(notebook: Any) -> str:
    """The first sentence below the first heading of a notebook."""
    return _first_sentence(next(iter(_texts(notebook)), ""))


def _texts(notebook: Any) -> list[str]:
    return [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]


def _first_sentence(source: str) -> str:
    """Of Markdown, without its heading and its marks."""
    text = " ".join(line for line in source.splitlines() if not line.startswith("#"))
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)|[*`]|\b_|_\b", lambda found: found[1] or "", text)
    text = text.strip().removeprefix("- ")
    return re.split(r"(?<=[.?!:]) ", text)[0].rstrip(":")


def _page(title: str, style: str, body: list[str]) -> str:
    return "\n".join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}{style}</style></head>",
        "<body>",
        *body,
        "</body></html>\n",
    ])  # fmt: skip


def _from_above(text: str) -> str:
    """Pictures and links beside the notebook, as seen from the folder of pages."""
    return re.sub(r'(src|href)="(?!https?:|#|/|data:)', r'\1="../', text)


def _output(output: Any, markdown: Any, about: str) -> str:
    if output.output_type == "stream":
        return f'<pre class="output">{html.escape(output.text)}</pre>' if output.name == "stdout" else ""
    data = output.get("data", {})
    if "application/vnd.jupyter.widget-view+json" in data:  # a progress bar, long done
        return ""
    if "image/png" in data:
        return f'<p><img src="{small_picture(data["image/png"])}" alt="{html.escape(about)}"></p>'
    if "image/webp" in data:
        return f'<p><img src="data:image/webp;base64,{data["image/webp"]}" alt="{html.escape(about)}"></p>'
    if "text/html" in data:
        return f'<div class="output">{small_table(data["text/html"])}</div>'
    if "text/markdown" in data:
        return f'<div class="output">{_from_above(markdown.render(data["text/markdown"]))}</div>'
    text = data.get("text/plain", "")
    return f'<pre class="output">{html.escape(text)}</pre>' if text and not text.startswith("<Figure") else ""


def small_table(table: str) -> str:
    """HTML of a table without the ids and classes of cells that no style speaks of."""
    styles = " ".join(re.findall(r"<style.*?</style>", table, re.DOTALL))
    ids, classes = (set(re.findall(rf"{mark}([A-Za-z][\w-]*)", styles)) for mark in ("#", r"\."))

    def cell(found: re.Match[str]) -> str:
        kept = [name for name in found["names"].split() if name in (ids if found["what"] == "id" else classes)]
        return f' {found["what"]}="{" ".join(kept)}"' if kept else ""

    attribute = re.compile(r' (?P<what>id|class)="(?P<names>[^"]*)"')
    return re.sub(r"<t[dhr]\b[^>]*>", lambda tag: attribute.sub(cell, tag[0]).replace(" >", ">"), table)


def small_picture(png: str) -> str:
    """A PNG in base64 as the address of a smaller picture: as WebP without loss, or, where that remains large, no wider
    than the page and with or without a little loss, whichever is smaller."""
    with Image.open(io.BytesIO(base64.b64decode(png))) as image:
        flat = Image.new("RGB", image.size, "white")
        flat.paste(image, mask=image.getchannel("A") if "A" in image.getbands() else None)
    smallest = _webp(flat, lossless=True)
    if len(smallest) > LARGE:
        if flat.width > WIDEST_PX:
            flat = flat.resize((WIDEST_PX, round(flat.height * WIDEST_PX / flat.width)), Image.Resampling.LANCZOS)
        smallest = min(_webp(flat, lossless=True), _webp(flat, quality=QUALITY), key=len)
    return f"data:image/webp;base64,{base64.b64encode(smallest).decode()}"


def _webp(image: Image.Image, **options: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "WEBP", method=6, **options)
    return stream.getvalue()


def main(arguments: list[str]) -> int:
    """Write the page of every notebook in a folder; those that fail are named. Returns the exit code."""
    import jupytext
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    folder = Path(arguments[0])
    out = Path(arguments[1])
    notebooks = sorted(folder.glob("[0-9]*.py"))  # not this file
    titles = {path.stem: title_of(jupytext.read(path)) for path in notebooks}
    paths = [path for path in notebooks if len(arguments) < 3 or path.stem in arguments[2:]]
    failed = []
    out.mkdir(parents=True, exist_ok=True)
    for path in paths:
        start = time.monotonic()
        try:
            page = notebook_page(run_notebook(path), path.stem, titles)
        except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
            failed.append(path.stem)
            what = f"{error.ename}: {error.evalue}" if isinstance(error, CellExecutionError) else str(error)
            print(f"{path.stem}: {what}", file=sys.stderr)
            continue
        (out / f"{path.stem}.html").write_text(page, encoding="utf-8")
        print(f"{path.stem}: {len(page) / 1e3:.0f} kB in {time.monotonic() - start:.0f} s -> {out / path.stem}.html")
    pages = {}
    for path in notebooks:
        written = out / f"{path.stem}.html"
        if written.exists():
            found = re.search(r'<img src="(data:[^"]+)"', written.read_text(encoding="utf-8"))
            pages[path.stem] = (titles[path.stem], about_of(jupytext.read(path)), found[1] if found else "")
    (out / "index.html").write_text(index_page(pages), encoding="utf-8")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
