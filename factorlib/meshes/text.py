"""Text in mesh files: UTF-8, or else Latin-1, in which old programs write names and comments."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

SHOWN = 80  # characters of a line in a message
LONGEST = 2_000_000  # characters of a line


def lines_of(content: bytes) -> Iterator[str]:
    """Lines, whichever of the three ways they end; characters that Python alone takes for line ends are none.  ValueError
    for one of more than LONGEST characters.

    >>> list(lines_of("Stühle\\r\\nb\\rc\\x0cd\\n".encode("utf-8-sig"))), list(lines_of("Stühle".encode("latin-1")))
    (['Stühle', 'b', 'c\\x0cd'], ['Stühle'])
    """
    with io.TextIOWrapper(
        io.BytesIO(content), _encoding_of(content)
    ) as text:  # line by line: a list of them is far larger
        for line in text:
            check_length(len(line))
            yield line.rstrip("\n")


def check_length(letters: int) -> None:
    """Words of a line are objects of their own: ValueError for more of them than any polygon has corners."""
    if letters > LONGEST:
        raise ValueError(f"a line of more than {LONGEST:,} letters")


def _encoding_of(content: bytes) -> str:
    try:
        content.decode("utf-8-sig")
        return "utf-8-sig"
    except UnicodeDecodeError:
        return "latin-1"


def numbers_in(text: str | bytes) -> Float[np.ndarray, " n"]:
    """All numbers of a text, whatever white space is between them; ValueError for anything else in it.

    >>> numbers_in("1 2.5\\n-3e2").tolist()
    [1.0, 2.5, -300.0]
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy stops at what is no number, with a warning
        try:
            return np.fromstring(text, dtype=float, sep=" ") if text.strip() else np.empty(0)
        except DeprecationWarning:
            raise ValueError("something in it is no number") from None


def shown(line: str) -> str:
    """A line as messages quote it, cut to SHOWN characters."""
    line = line.strip()
    return repr(line if len(line) <= SHOWN else line[: SHOWN - 1] + "…")
