"""Diffuse and specular radiance of one photo's pixels, from the solved materials in its solved light.

`texture` finds paint as a factor on the diffuse part, and `render` adds both parts to the re-synthesis.

Writes <photo>.exr: diffuse.R, G, B and specular.R, G, B, linear, in the unit of the photo.  They include shadows and
interreflection, but no tone curve.  They are 0 outside the masks and where no mesh lies under them.
"""

from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from factorlib.dataset.schema import LightSlice
from factorlib.images.exr import read_exr, write_exr
from factorlib.reflection import reflection_operator
from factorlib.render.resynthesis import SHADING, Reflector, read_surroundings, resynthesise
from factorlib.results.lobe_table import read_photo_light
from factorlib.results.materials import read_materials, select_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import read_geometry


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the shading."""

    operator: Literal["network", "closed_form", "reference", "paper_network"] = "network"
    """Operator that reflects the lights; network: the fitted one (`factorlib.reflection`)."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Write the diffuse and the specular radiance of a photo's pixels."""
    name = inputs.photo
    assert name is not None  # a stage over one photo
    file = inputs["solve"] / "materials.json"
    solved = read_materials(file)
    slice_ = msgspec.convert(inputs.facts["dataset.light"], LightSlice)
    operator = reflection_operator(params.operator, weights=inputs["train"])
    light = read_photo_light(inputs["solve"], name, slice_)
    parts = resynthesise(
        Reflector(operator, light, solved.model.curvature(slice_.illumination)),
        select_materials(solved, inputs.facts["dataset.materials"], file),
        read_exr(inputs["masks"] / f"{name}.exr"),
        read_geometry(inputs["align"], inputs.folders.get("surface"), name),
        lambda done, pixels: progress(done, pixels, f"{name}: {done} of {pixels} pixels"),
        read_surroundings(inputs.folders, name, solved.model),
    )
    channels = np.moveaxis(parts, -1, 1).reshape(len(SHADING), *parts.shape[1:3])
    write_exr(out / f"{name}.exr", dict(zip(SHADING, channels)))
