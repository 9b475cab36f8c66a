"""A scene for Blender: a script, the same for every set, and what it builds of each photo, as JSON.

The script (`blender.py.txt` in this package, exported as `blender.py`) needs nothing but Blender; a `.blend` file would need Blender to
be written and would not be the same bytes twice.  The JSON is the scene of `factorlib.export.mitsuba` in plain numbers:

    camera     width, height, focal_px, principal_point in pixels, centres at 0.5
    shapes     name, file (relative), material, cam_from_object: 4 × 4, rows, mesh units, OpenCV's camera axes
    materials  diffuse k_d, specular k_s (linear Rec. 709), roughness
    light      file (relative): lat-long map of texel means, exposure: factor per channel, camera_from_light: 3 × 3
    max_depth  2 direct light alone, −1 all bounces
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.export.mitsuba import Shape, View
from factorlib.jsonfile import write_json
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_text


class ExposedMap(msgspec.Struct, frozen=True):
    """A lat-long map (relative to the scene), a factor per channel on it, and camera_from_light: the identity unless fixed to the world."""

    file: str
    exposure: Float[np.ndarray, "3"]
    camera_from_light: Float[np.ndarray, "3 3"]


def write_script(folder: str | Path) -> None:
    """Write blender.py, which builds the scenes that `write_scene_json` writes to the same folder."""
    script = files("factorlib.export").joinpath("blender.py.txt").read_text(encoding="utf-8")
    write_text(Path(folder) / "blender.py", script)


def write_scene_json(
    path: str | Path,
    view: View,
    shapes: Sequence[Shape],
    materials: Mapping[str, Reflectance],
    light: ExposedMap,
    max_depth: int,
) -> None:
    """Write a photo's scene; of `materials` those that shapes name."""
    used = sorted({shape.material for shape in shapes})
    placed = [_plain(shape, "name", "file", "material", "cam_from_object") for shape in shapes]
    lit, named = _plain(light, "file", "exposure", "camera_from_light"), {name: materials[name] for name in used}
    scene = {"camera": view, "shapes": placed, "materials": named, "light": lit, "max_depth": max_depth}
    write_json(path, scene)


def _plain(of: Shape | ExposedMap, *names: str) -> dict[str, Any]:
    values = {name: getattr(of, name) for name in names}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
