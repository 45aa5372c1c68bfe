"""Run notebooks and write each as one small HTML file with its pictures in it.

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
body { max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #333; font: 16px/1.5 system-ui, sans-serif }
pre { padding: .5rem .8rem; overflow-x: auto; font-size: 13px; line-height: 1.4; background: #f6f8fa }
pre.output { background: none; border-left: 3px solid #ddd }
img { max-width: 100% }
div.output { overflow-x: auto; font-size: 13px }
table { border-collapse: collapse; margin: .5rem 0 }
td, th { padding: 2px 8px; border-bottom: 1px solid #ddd; text-align: left }
nav a { margin-right: 1em }
"""

LARGE, QUALITY, WIDEST_PX = 25_000, 55, 960
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


def notebook_page(notebook: Any, title: str, others: list[str] | None = None) -> str:
    """A notebook with outputs as an HTML page.

    Args:
        notebook: as nbformat holds it.
        title: of the page.
        others: names of pages beside this one to link to.
    """
    from markdown_it import MarkdownIt
    from pygments import highlight
    from pygments.formatters import HtmlFormatter
    from pygments.lexers import PythonLexer

    markdown, formatter = MarkdownIt("commonmark").enable("table"), HtmlFormatter(nobackground=True)
    body = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            body.append(_from_above(markdown.render(cell.source)))
        elif cell.cell_type == "code":
            body.append(highlight(cell.source, PythonLexer(), formatter))
            body += [_output(output, markdown) for output in cell.outputs]
    links = "".join(f'<a href="{name}.html">{name}</a>' for name in others or [])
    return "\n".join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        f"<style>{_STYLE}{formatter.get_style_defs('.highlight')}</style></head>",
        f"<body><nav>{links}</nav>",
        *body,
        "</body></html>\n",
    ])  # fmt: skip


def _from_above(text: str) -> str:
    """Pictures and links beside the notebook, as seen from the folder of pages."""
    return re.sub(r'(src|href)="(?!https?:|#|/|data:)', r'\1="../', text)


def _output(output: Any, markdown: Any) -> str:
    if output.output_type == "stream":
        return f'<pre class="output">{html.escape(output.text)}</pre>' if output.name == "stdout" else ""
    data = output.get("data", {})
    if "application/vnd.jupyter.widget-view+json" in data:  # a progress bar, long done
        return ""
    if "image/png" in data:
        return f'<p><img src="{small_picture(data["image/png"])}" alt=""></p>'
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
    from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

    folder, out = Path(arguments[0]), Path(arguments[1])
    notebooks = sorted(folder.glob("[0-9]*.py"))  # not this file
    names = [path.stem for path in notebooks]
    paths = [path for path in notebooks if len(arguments) < 3 or path.stem in arguments[2:]]
    failed = []
    out.mkdir(parents=True, exist_ok=True)
    for path in paths:
        start = time.monotonic()
        try:
            page = notebook_page(run_notebook(path), path.stem, names)
        except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
            failed.append(path.stem)
            what = f"{error.ename}: {error.evalue}" if isinstance(error, CellExecutionError) else str(error)
            print(f"{path.stem}: {what}", file=sys.stderr)
            continue
        (out / f"{path.stem}.html").write_text(page, encoding="utf-8")
        print(f"{path.stem}: {len(page) / 1e3:.0f} kB in {time.monotonic() - start:.0f} s -> {out / path.stem}.html")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
