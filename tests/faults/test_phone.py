"""Photos as phones take them: 48 megapixels cost no more memory than a step may take."""

import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

ROWS, COLUMNS = 6000, 8000
MOST_MB = 900  # floating-point radiance of the photo alone would be 576; 300 are Python and its libraries
STEP = """
import json, sys
from pathlib import Path
from factorlib.runner.cost import Meter
from factorlib.stage import Inputs
from stages import masks

folder = Path(sys.argv[1])
photo = {"image": "a.jpg", "encoding": None, "masks": "a.png", "focal_px": None, "illumination": "a", "objects": []}
meter = Meter()
facts = {"dataset.photo": photo, "dataset.materials": ["red", "white"]}
masks.main(masks.Params(), Inputs({}, facts, {name: folder / name for name in ("a.jpg", "a.png")}, "a"), folder)
print(json.dumps(meter.read(1)))
"""


@pytest.mark.long
def test_a_photo_of_48_megapixels_is_read_in_strips(tmp_path):
    wave = np.sin(np.arange(COLUMNS) / 50)[None] * np.sin(np.arange(ROWS) / 70)[:, None]
    Image.fromarray(np.repeat((110 + 100 * wave).astype(np.uint8)[..., None], 3, axis=2)).save(
        tmp_path / "a.jpg", quality=90
    )
    label = np.zeros((ROWS, COLUMNS), np.uint8)
    label[1000:5000, 2000:6000], label[2000:4000, 3000:5000] = 1, 2  # a third of the photo
    Image.fromarray(label).save(tmp_path / "a.png", compress_level=1)
    del wave, label
    said = subprocess.run(
        [sys.executable, "-c", STEP, str(tmp_path)], check=True, capture_output=True, text=True
    ).stdout
    facts = json.loads((tmp_path / "a.json").read_text())
    assert (
        facts["factor"] == 4
        and sum(facts["pixels"].values()) == 1_000_000
        and (facts["width"], facts["height"]) == (2000, 1500)
    )
    assert json.loads(said)["memory_mb"] < MOST_MB
