"""Blender, in a process of its own: its libraries do not get on with others of the same names."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from factorlib.images.exr import read_exr

MISSING = 'Blender is not installed: make setup EXTRAS="blender", or put `blender` on the PATH'


def rendered(scenes: Path, photos: Sequence[str], samples: int, *words: str) -> dict[str, np.ndarray]:
    """RGBA of the photos, by the script beside them, all in one process; skips the test where there is no Blender."""
    jobs = [
        [photo, "--render", str(scenes / f"{photo}.blender.exr"), "--samples", str(samples), *words] for photo in photos
    ]
    code = (
        f"import sys; sys.path.insert(0, {str(scenes)!r})\nimport blender\nfor words in {jobs!r}: blender.main(words)"
    )
    run(code)
    return {photo: rgba(scenes / f"{photo}.blender.exr") for photo in photos}


def run(code: str) -> None:
    """Python in Blender; skips the test where there is none."""
    done = subprocess.run(_command(code), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def _command(code: str) -> list[str]:
    if importlib.util.find_spec("bpy"):
        return [sys.executable, "-W", "ignore", "-c", code]
    if program := shutil.which("blender"):
        return [program, "--background", "--python-exit-code", "1", "--python-expr", code]
    pytest.skip(MISSING)


def rgba(path: Path) -> np.ndarray:
    """[rows, columns, 4] of an EXR."""
    channels = read_exr(path)
    return np.stack([channels[name] for name in "RGBA"], axis=-1)
