"""Text in mesh files: UTF-8, or else Latin-1, in which old programs write names and comments."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float

SHOWN = 80  # characters of a line in a message


def decoded(content: bytes) -> str:
    """
    >>> decoded("Stühle".encode("latin-1")), decoded("Stühle".encode("utf-8-sig"))
    ('Stühle', 'Stühle')
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def lines_of(content: bytes) -> list[str]:
    """Lines, whichever of the three ways they end; characters that Python alone takes for line ends are none.

    >>> lines_of(b"a\\r\\nb\\rc\\x0cd\\n")
    ['a', 'b', 'c\\x0cd', '']
    """
    return decoded(content).replace("\r\n", "\n").replace("\r", "\n").split("\n")


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
    line = line.strip()
    return repr(line if len(line) <= SHOWN else line[: SHOWN - 1] + "…")
