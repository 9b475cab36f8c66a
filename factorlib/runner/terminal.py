"""What a terminal is shown: text alone.  A name or a message from a file can move no cursor, set no colour or title, ring no bell.

Names of files and words of parsers stand in messages, and a data set may come from anywhere.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any, TextIO


def printable(text: str) -> str:
    """`text` with every character that prints nothing, but for ends of lines, in the form that Python's literals have.

    >>> printable("a\\x1b[31mb\\u202ec\\n")
    'a\\\\x1b[31mb\\\\u202ec\\n'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class Plain:
    """A stream that writes printable text to another, which has all else."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def write(self, text: str) -> int:
        """As of a text stream, which takes no bytes."""
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        return self.stream.write(printable(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def plain_streams() -> Iterator[None]:
    """Within, standard output and standard error are plain."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(Plain, before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def own(stream: TextIO) -> TextIO:
    """The stream below a plain one, for what draws on a terminal itself."""
    return stream.stream if isinstance(stream, Plain) else stream
