"""Re-synthesis of one photo from materials and light, with a ball of every material in its light.

Writes resynthesis/<photo> and materials/<photo>/<material> (balls, which are reflectance maps too), each a linear EXR
and a PNG at the photo's exposure.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from factorlib.dataset.schema import LightSlice
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.picture import exposure_of, picture, write_png
from factorlib.reflection import reflection_operator
from factorlib.render.resynthesis import Reflector, paint_shading, render_ball
from factorlib.results.exchange import with_exchange
from factorlib.results.lobe_table import read_photo_light
from factorlib.results.materials import read_materials, select_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import read_geometry

Size = Annotated[int, msgspec.Meta(ge=8, le=2048)]


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reflection operator and sizes of pictures."""

    operator: Literal["network", "closed_form", "reference", "paper_network"] = "network"
    """Reflection operator of balls; that of the re-synthesis is `shading.operator`."""
    ball_size: Size = 128
    """Width and height of a ball's picture, in pixels."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render the re-synthesis of a photo, and a ball of every material in its light."""
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
    for k, (label, material) in enumerate(zip(names, materials, strict=True)):
        progress(k, len(names), f"{name}: {label}")
        ball = render_ball(reflector, material, params.ball_size)
        _write(out / "materials" / name / label, ball, exposure, ball=True)
    progress(len(names), len(names), name)


def _write(stem: Path, radiance: np.ndarray, exposure: float, ball: bool) -> None:
    """Write a picture as EXR and PNG.

    Args:
        stem: Path of both files, without suffix.
        radiance: Linear radiance, [h, w, 3].
        exposure: Exposure of the PNG.
        ball: True for a ball; the PNG is transparent around it.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    pixels = picture(radiance, exposure)
    if ball:
        alpha = 255 * ball_normals(len(pixels))[1][..., None].astype(np.uint8)
        pixels = np.concatenate([pixels, alpha], axis=-1)
    write_exr(stem.with_name(stem.name + ".exr"), dict(zip("RGB", np.moveaxis(radiance, -1, 0))))
    write_png(stem.with_name(stem.name + ".png"), pixels)
