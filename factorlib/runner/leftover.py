"""Files that nobody meant: what Python, editors and desktops leave beside others, and drafts of writers that were killed."""

from __future__ import annotations

import contextlib
import os
import re
import time
from pathlib import Path

DRAFT = re.compile(r"\..+\.([0-9]{1,9})")  # of `factorlib.wholefile.replace_file`: a dot, the name, the process
OLD = 3600.0  # seconds: what is younger may be written by a process of another machine that shares the folder


def left_over(name: str) -> bool:
    """Whether a file or folder of that name is hidden, a backup, or compiled Python.

    >>> [left_over(name) for name in (".a.c.swp", "a.c~", "#a.c#", "__pycache__", "a.pyc", "a.c")]
    [True, True, True, True, True, False]
    """
    return name.startswith((".", "#")) or name.endswith(("~", ".pyc")) or name == "__pycache__"


def sweep_drafts(folder: Path) -> None:
    """Delete the drafts of writers that were killed: their process is no more, and they are OLD."""
    for path in folder.glob(".*"):
        found = DRAFT.fullmatch(path.name)
        with contextlib.suppress(OSError):
            if found and not is_alive(int(found[1])) and time.time() - path.lstat().st_mtime > OLD:
                path.unlink()


def is_alive(pid: int) -> bool:
    """Whether there is such a process on this machine, whoever's it is."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
