"""MaterialX' own renderer shows of the exported file what `factorlib.export.viewers` says that it shows."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from factorlib.export.loss import in_lamp
from factorlib.export.materialx import materialx
from factorlib.export.viewers import MODELS
from factorlib.results.materials import Reflectance
from tests.export import made_export

SIZE = 48
LAMP = np.array([0.9, 0.2, -0.6])  # from behind, where shadowing and Fresnel count most
MATERIALS = {
    "glossy": Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.6),
    "metal": Reflectance((0, 0, 0), (0.8, 0.6, 0.4), 0.7),
    "lambertian": Reflectance((0.5, 0.4, 0.3), (0, 0, 0), 0.5),
}
SURFACES = {"surface": MODELS["mtlx"], "standard_surface_surface": MODELS["mtlx_standard_surface"]}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    pytest.importorskip("MaterialX", reason='MaterialX is not installed: make setup EXTRAS="interchange"')
    screen = [] if "DISPLAY" in os.environ else ["xvfb-run", "-a"]
    if screen and not shutil.which(screen[0]):
        pytest.skip("MaterialX draws on a screen alone: install xvfb and libgl1-mesa-dri")
    folder = tmp_path_factory.mktemp("materialx")
    (folder / "m.mtlx").write_text(materialx(MATERIALS))
    made_export.write_obj(folder / "points.obj", (1, 1, 1))  # the unit ball's points are its normals
    lines = (folder / "points.obj").read_text().splitlines()
    points, faces = ([line for line in lines if line.startswith(letter)] for letter in "vf")
    corners = ["f " + " ".join(f"{k}//{k}" for k in face.split()[1:]) for face in faces]
    (folder / "ball.obj").write_text("\n".join([*points, *("vn" + point[1:] for point in points), *corners]) + "\n")
    names = [f"m_{material}_{surface}" for material in MATERIALS for surface in SURFACES]
    script = [
        sys.executable, str(Path(__file__).with_name("in_materialx.py")), str(folder), str(SIZE),
        ",".join(map(str, LAMP)), *names,
    ]  # fmt: skip
    done = subprocess.run([*screen, *script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return {name: np.load(folder / f"{name}.npy") for name in names}


@pytest.mark.long
@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("surface", SURFACES)
def test_shaders_show_what_the_model_says(pictures, material, surface):
    at = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(at, at)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    lit = (normal[..., 2] > 0.15) & (normal @ LAMP > 0.1)
    expected = in_lamp(MATERIALS[material], SURFACES[surface], normal[lit], LAMP)
    error = np.abs(pictures[f"m_{material}_{surface}"][lit] / expected - 1)
    assert lit.sum() > 200  # MaterialX fits its albedo E by a rational function
    assert np.median(error) < 0.015 and np.percentile(error, 95) < 0.06
