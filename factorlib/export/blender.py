"""Export of a photo's scene to Blender: a script that is the same for every set, and the scene as JSON.

The script (`blender.py.txt` in this package, exported as `blender.py`) needs nothing but Blender.  A `.blend` file
would need Blender to be written and would not be the same bytes twice.  The JSON is a
`factorlib.export.exported_scene.ExportedScene` in plain numbers:

    camera     width, height, focal_px, principal_point in pixels, centres at 0.5
    shapes     name, file (relative), material, cam_from_object: 4 × 4, rows, mesh units, OpenCV's camera axes
    materials  diffuse k_d, specular k_s (linear Rec. 709), roughness
    light      file (relative): lat-long map of texel means, exposure: factor per channel, camera_from_light: 3 × 3
    suns       not in the map: direction (toward it, y-up camera frame), irradiance (RGB), angular_diameter_deg
    max_depth  2 direct light alone, −1 all bounces
"""

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from factorlib.export.exported_scene import ExportedScene, ExportedShape, ExposedMap, Sun
from factorlib.jsonfile import write_json
from factorlib.wholefile import write_text


def write_script(folder: str | Path) -> None:
    """Write blender.py, which builds the scenes that `write_scene_json` writes to the same folder."""
    script = files("factorlib.export").joinpath("blender.py.txt").read_text(encoding="utf-8")
    write_text(Path(folder) / "blender.py", script)


def write_scene_json(path: str | Path, scene: ExportedScene) -> None:
    """Write a photo's scene as JSON, with the materials that its shapes name."""
    camera = scene.camera
    write_json(
        path,
        {
            "camera": {
                "width": camera.width,
                "height": camera.height,
                "focal_px": camera.focal,
                "principal_point": camera.centre,
            },
            "shapes": [_plain(shape, "name", "file", "material", "cam_from_object") for shape in scene.shapes],
            "materials": {shape.material: scene.materials[shape.material] for shape in scene.shapes},
            "light": _plain(scene.light, "file", "exposure", "camera_from_light"),
            "suns": [_plain(sun, "direction", "irradiance", "angular_diameter_deg") for sun in scene.suns],
            "max_depth": scene.max_depth,
        },
    )


def _plain(item: ExportedShape | ExposedMap | Sun, *names: str) -> dict[str, Any]:
    values = {name: getattr(item, name) for name in names}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
