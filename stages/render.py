"""Re-synthesis of one photo from materials and light, with balls and reflectance maps of every material in its light.

Writes resynthesis/<photo>, materials/<photo>/<material> (balls) and reflectance_maps/<photo>/<material>.  Each is a
linear EXR and a PNG at the photo's exposure.  Channel `observed` of a reflectance map is 1 where the photo shows that
normal.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from scipy.ndimage import binary_erosion

from factorlib.dataset.schema import LightSlice
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.picture import exposure_of, picture, write_png
from factorlib.reflection import reflection_operator
from factorlib.render.resynthesis import Reflector, observed_cells, paint_shading, render_balls
from factorlib.results.exchange import with_exchange
from factorlib.results.lobe_table import read_photo_light
from factorlib.results.materials import read_materials, select_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import observed_pixels, read_geometry

Size = Annotated[int, msgspec.Meta(ge=8, le=2048)]
RING = (255, 255, 255)


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reflection operator and sizes of pictures."""

    operator: Literal["network", "closed_form", "reference", "paper_network"] = "network"
    """Reflection operator of balls and reflectance maps; that of the re-synthesis is `shading.operator`."""
    ball_size: Size = 128
    """Width and height of a ball's picture, in pixels."""
    map_size: Size = 64
    """Width and height of a reflectance map, in pixels."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render the re-synthesis of a photo, and balls and reflectance maps of every material in its light."""
    inputs, name = with_exchange(inputs), inputs.photo
    assert name is not None  # a stage over one photo
    names = inputs.facts["dataset.materials"]
    file = inputs["export"] / "materials.json"
    exported = read_materials(file)
    model = read_materials(inputs["solve"] / "materials.json").model
    photo = read_exr(inputs["masks"] / f"{name}.exr")
    geometry = read_geometry(inputs["align"], inputs.folders.get("surface"), name, inputs.folders.get("texture"))
    slice_ = msgspec.convert(inputs.facts["dataset.light"], LightSlice)
    light = read_photo_light(inputs["export"], name, slice_)
    operator = reflection_operator(params.operator, weights=inputs["train"])
    reflector = Reflector(operator, light, model.curvature(slice_.illumination))
    exposure = exposure_of(np.stack([photo[c] for c in "RGB"], axis=-1), photo["valid"] > 0.5)
    materials = select_materials(exported, names, file)
    radiance = paint_shading(inputs["shading"], name, geometry, model)
    _write(out / "resynthesis" / name, radiance, exposure, ball=False)
    # balls and reflectance maps, material by material
    observed = observed_pixels(photo, geometry)
    for k, (label, material) in enumerate(zip(names, materials, strict=True), start=1):
        progress(k - 1, len(names), f"{name}: {label}")
        shaded, reflectance_map = render_balls(reflector, material, (params.ball_size, params.map_size))
        _write(out / "materials" / name / label, shaded, exposure, ball=True)
        pixels = observed & (np.rint(photo["label"]) == k)
        cells = observed_cells(np.stack([geometry[f"normal.{a}"][pixels] for a in "xyz"], axis=-1), params.map_size)
        _write(out / "reflectance_maps" / name / label, reflectance_map, exposure, ball=True, observed=cells)
    progress(len(names), len(names), name)


def _write(stem: Path, radiance: np.ndarray, exposure: float, ball: bool, observed: np.ndarray | None = None) -> None:
    """Write a picture as EXR and PNG.

    Args:
        stem: Path of both files, without suffix.
        radiance: Linear radiance, [h, w, 3].
        exposure: Exposure of the PNG.
        ball: True for a ball; the PNG is transparent around it.
        observed: Mask of observed normals, [h, w]: a channel of the EXR, outlined in the PNG.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    channels = dict(zip("RGB", np.moveaxis(radiance, -1, 0)))
    pixels = picture(radiance, exposure)
    if observed is not None:
        channels["observed"] = observed
        pixels[observed & ~binary_erosion(observed)] = RING
    if ball:
        alpha = 255 * ball_normals(len(pixels))[1][..., None].astype(np.uint8)
        pixels = np.concatenate([pixels, alpha], axis=-1)
    write_exr(stem.with_name(stem.name + ".exr"), channels)
    write_png(stem.with_name(stem.name + ".png"), pixels)
