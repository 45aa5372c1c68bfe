"""Execute notebooks and store their outputs: figures as PNG, tables and text without what differs between executions.

    python notebooks/execute.py                     # all, from the runs of data/release
    python notebooks/execute.py 05_tables 08_runtimes

The text of a notebook is that of its script; a store of the release's runs is made first, unless WHERETOLOOK_MLRUNS
names one.
"""

from __future__ import annotations

import base64
import io
import os
import re
import sys
import tempfile
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

FOLDER = Path(__file__).parent
WIDEST_PX = 1000
COLORS = 256
"""Width of a figure at most, and the colours of its palette, which take a third of the space of all colours."""


def execute(script: Path, timeout_s: float = 600) -> NotebookNode:
    """Return the notebook of a script in Jupytext's percent format with its outputs, executed in the script's folder.

    Args:
        script: the `.py` file.
        timeout_s: of one cell.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails.
    """
    notebook = jupytext.read(script)
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number}"  # Jupytext draws them at random
    resources = {"metadata": {"path": str(script.parent)}}
    client = NotebookClient(
        notebook, timeout=timeout_s, kernel_name="python3", resources=resources, record_timing=False
    )
    client.execute()
    notebook.metadata.pop("language_info", None)  # the version of Python
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [kept for output in cell.outputs if (kept := _cleaned(output, cell.id))]
    return notebook


def _cleaned(output: NotebookNode, cell: str) -> NotebookNode | None:
    """Return an output of a cell in its richest form that hosting sites show; None of warnings and progress bars."""
    if output.output_type == "stream":
        return output if output.name == "stdout" else None
    data = output.data
    for mime in ("image/png", "image/webp"):
        if mime in data:
            shown_px = output.metadata.get(mime, {}).get("width", WIDEST_PX)
            output.data, output.metadata = _picture(base64.b64decode(data[mime]), shown_px)
            return output
    for mime in ("text/html", "text/markdown", "text/plain"):  # pandas draws the ids of styled tables at random
        if mime in data and "application/vnd.jupyter.widget-view+json" not in data:
            output.data = NotebookNode({mime: re.sub(r"\bT_[0-9a-f]{5}(?=_|\b)", f"T-{cell}", data[mime])})
            output.metadata = NotebookNode()
            return output
    return None


def _picture(content: bytes, shown_px: int) -> tuple[NotebookNode, NotebookNode]:
    """Return data and metadata of a picture as a PNG with a palette, no wider than `WIDEST_PX`."""
    picture = Image.open(io.BytesIO(content)).convert("RGB")
    if picture.width > WIDEST_PX:
        picture = picture.resize(
            (WIDEST_PX, round(picture.height * WIDEST_PX / picture.width)), Image.Resampling.LANCZOS
        )
    written = io.BytesIO()
    palette = Image.new("P", (1, 1), 0)
    covered = picture.quantize(COLORS - 1, Image.Quantize.MAXCOVERAGE)  # also the colours of small areas, as of scales
    palette.putpalette([255, 255, 255, *(covered.getpalette() or ())])
    picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(written, "png", optimize=True)
    width = min(shown_px, picture.width)
    size = {"width": width, "height": round(picture.height * width / picture.width)}
    return NotebookNode({"image/png": base64.b64encode(written.getvalue()).decode()}), NotebookNode({"image/png": size})


def main(names: list[str]) -> int:
    """Execute the named notebooks, by default all, and write them; return 1 if one fails, 2 if there is none of a name."""
    scripts = {script.stem: script for script in sorted(FOLDER.glob("[0-9]*.py"))}
    if unknown := {*names} - {*scripts}:
        print(f"no such notebook: {', '.join(sorted(unknown))}. Notebooks: {', '.join(scripts)}.", file=sys.stderr)
        return 2
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        if not os.environ.get("WHERETOLOOK_MLRUNS"):
            os.environ["WHERETOLOOK_MLRUNS"] = str(Path(folder) / "mlruns")
            os.chdir(FOLDER)
            from wheretolook_paper.release.notebook import open_store

            open_store()
        for script in (scripts[name] for name in names or scripts):
            start = time.perf_counter()
            try:
                notebook = execute(script)
            except Exception as error:
                failed.append(f"{script.stem}: {error}")
                print(failed[-1], file=sys.stderr)
                continue
            path = script.with_suffix(".ipynb")
            nbformat.write(notebook, path)
            print(f"{path.name}: {time.perf_counter() - start:.0f} s, {path.stat().st_size / 1e3:,.0f} kB", flush=True)
    return len(failed) > 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
