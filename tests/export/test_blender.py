"""Exported scenes in Blender, by its script, beside Mitsuba's picture: frames, light and materials.

Blender runs in a process of its own: its libraries do not get on with others of the same names.
"""

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from factorlib.images.exr import read_exr
from factorlib.tracing.variant import mitsuba
from tests.export import made_export

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


@pytest.mark.long
def test_round_trip_shows_what_mitsuba_shows(exported):
    inputs, out = exported
    photos, module = list(made_export.MESHES), mitsuba()
    found = rendered(out / "scenes", photos, 256)
    for photo in photos:
        expected = np.array(module.render(module.load_file(str(out / "scenes" / f"{photo}.xml")), spp=512))
        mask = binary_erosion(read_exr(inputs["align"] / f"{photo}.exr")["label"] > 0, np.ones((3, 3)))
        error = np.abs(found[photo][mask][:, :3] / expected[mask] - 1)
        print(f"{photo}: difference {np.median(error):.2%} (median), {np.percentile(error, 95):.2%} (95th percentile)")
        assert np.median(error) <= 0.03 and np.percentile(error, 95) <= 0.1
        assert found[photo][mask][:, 3].min() == 1.0
