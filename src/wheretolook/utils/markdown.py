"""Tables in Markdown, and numbers of things in texts."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose columns also line up as plain text."""
    widths = [max(len(line[column]) for line in [header, *rows]) for column in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )


def counted(number: float, noun: str) -> str:
    """Return a rounded number and its noun, such as "1 landmark" and "1,260 landmarks"."""
    return f"{number:,.0f} {noun}{'s' * (round(number) != 1)}"
