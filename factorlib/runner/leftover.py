"""Files that nobody meant: what Python, editors and desktops leave beside others."""

from __future__ import annotations


def left_over(name: str) -> bool:
    """Whether a file or folder of that name is hidden, a backup, or compiled Python.

    >>> [left_over(name) for name in (".a.c.swp", "a.c~", "#a.c#", "__pycache__", "a.pyc", "a.c")]
    [True, True, True, True, True, False]
    """
    return name.startswith((".", "#")) or name.endswith(("~", ".pyc")) or name == "__pycache__"
