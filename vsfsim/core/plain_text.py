"""Text from files and other people's code: made fit for a terminal, a Markdown page or a file name, or read as JSON."""

from __future__ import annotations

import hashlib
import json
import re
import unicodedata
from typing import Any

LONGEST = 2000
"""Characters of a text that are shown."""

_MARKUP = re.compile(r"([\\`*\[\]<>|&])")
_SEPARATORS = re.compile(r"[^A-Za-z0-9._+-]+")


def plain(text: object, *, longest: int = LONGEST) -> str:
    """``text`` in one line without control characters, which could move the cursor, colour a terminal or turn the
    direction of reading; a longer text than ``longest`` is cut and ends in an ellipsis."""
    words = str(text)
    if len(words) <= longest and words.isprintable():  # nearly always, and results have tens of thousands of names
        return words
    cut = len(words) > longest
    shown = "".join(" " if letter.isspace() else "?" if unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Co", "Cn")
                    else letter for letter in words[:longest])
    return shown + "..." * cut


def from_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: it is none, or is nested deeper than Python reads.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def markdown(text: object) -> str:
    """``text`` as `plain` text of a Markdown page: nothing in it is markup, HTML or the end of a table's cell."""
    return _MARKUP.sub(lambda match: f"&#{ord(match[1])};", plain(text))


def file_stem(text: object) -> str:
    """``text`` as a file name without an ending: letters, digits, ``. _ + -``, never a path, never hidden, never
    empty. Where letters of another alphabet, or those after the hundredth, are lost, the first digits of its sha256
    keep names apart."""
    stem = _SEPARATORS.sub(".", str(text)).strip(".")
    lost = len(stem) > 100 or any(letter.isalnum() and not letter.isascii() for letter in str(text))
    digest = f"-{hashlib.sha256(str(text).encode(errors='surrogatepass')).hexdigest()[:8]}" if lost else ""
    return (stem[:100] or "unnamed") + digest
