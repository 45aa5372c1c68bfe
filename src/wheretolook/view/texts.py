"""Words of files and clients, as the page shows them."""

from __future__ import annotations

import re

_PUNCTUATION = re.compile(r"([!-/:-@\[-`{-~])")  # all of ASCII's, each of which a backslash makes plain (CommonMark)


def plain(text: str) -> str:
    """A text that Markdown shows letter by letter.

    The page takes HTML in Markdown, with what it runs or loads; a name in a file, or in a link, must not be such.
    """
    return _PUNCTUATION.sub(r"\\\1", " ".join(text.split()))
