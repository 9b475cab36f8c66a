"""What was solved, as pictures: the photo synthesised again, and every material in the photo's light.

Writes resynthesis/<photo>, materials/<photo>/<material> (balls) and reflectance_maps/<photo>/<material> (channel
`observed`: 1 where the photo shows that normal), each as linear EXR and as PNG at the photo's own exposure.
"""

import logging
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from scipy.ndimage import binary_erosion

from factorlib.dataset.schema import LightSlice
from factorlib.images.exr import read_exr, write_exr, write_rgb_exr
from factorlib.images.picture import exposure_of, picture, write_png
from factorlib.images.tone import shown
from factorlib.model.interreflection import bounced_light
from factorlib.reflection import reflection_operator
from factorlib.render.ball import ball, ball_normals, observed_cells
from factorlib.render.photo_light import light_of
from factorlib.render.reflect import TAIL, Reflector
from factorlib.render.resynthesis import Surroundings, resynthesised
from factorlib.results.materials import Gauge, Model, Reflectance, in_order, read_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import observed_pixels
from factorlib.urm.observations import read_observations

log = logging.getLogger("factorlib.render")
Size = Annotated[int, msgspec.Meta(ge=8, le=2048)]
RING = (255, 255, 255)


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How pictures are computed, and their sizes."""

    operator: Literal["network", "closed_form", "reference", "paper_network"] = "network"
    """How a lobe's reflection is computed."""
    tail: Annotated[float, msgspec.Meta(ge=0, le=0.1)] = TAIL
    """Share of a pixel's radiance, of its faintest highlights, that the closed form gives; 0 for none."""
    ball_size: Size = 128
    """Pixels of a ball's side."""
    map_size: Size = 64
    """Pixels of the side of a reflectance map."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render a photo again, and balls and reflectance maps of every material in its light."""
    name, names = inputs.photo, inputs.facts["dataset.materials"]
    file = inputs["export"] / "materials.json"
    exported = read_materials(file)
    materials = in_order(exported, names, file)
    photo, geometry = (read_exr(inputs[stage] / f"{name}.exr") for stage in ("masks", "align"))
    light = light_of(inputs["export"], name, msgspec.convert(inputs.facts["dataset.light"], LightSlice))
    reflector = Reflector(reflection_operator(params.operator, weights=inputs["train"]), light, params.tail)
    exposure = exposure_of(np.stack([photo[c] for c in "RGB"], axis=-1), photo["valid"] > 0.5)
    total = 10 + len(names)

    def report(done: float, pixels: float) -> None:
        """Pixels of the re-synthesis."""
        progress(10 * done / pixels, total, f"{name}: {done} of {pixels} pixels")

    model = read_materials(inputs["solve"] / "materials.json").model
    tone = model.tone.get(name)
    again = resynthesised(reflector, materials, photo, geometry, report, surroundings(inputs, model, exported.gauge))
    _write(out / "resynthesis" / name, shown(again, tone.exponent, tone.pivot) if tone else again, exposure)
    seen = observed_pixels(photo, geometry)
    for k, (label, material) in enumerate(zip(names, materials, strict=True), start=1):
        progress(9 + k, total, f"{name}: {label}")
        pixels = seen & (np.rint(photo["label"]) == k)
        normals = np.stack([geometry[f"normal.{a}"][pixels] for a in "xyz"], axis=-1)
        _write(out / "materials" / name / label, ball(reflector, material, params.ball_size), exposure, disc=True)
        _write_map(out / "reflectance_maps" / name / label, reflector, material, normals, exposure, params.map_size)
    progress(total, total, name)


def surroundings(inputs: Inputs, model: Model, gauge: Gauge) -> Surroundings | None:
    """What the solve took into account of the photo's visibility, and of what its surfaces send to each other.

    gauge: of the materials that are rendered; its factor went out of the lights, but not out of what the photo shows
    """
    if not model.self_shadowing:
        return None
    seen = read_observations(inputs["urm"] / f"{inputs.photo}.parquet")
    sent = bounced_light(seen, seen.radiance.astype(float)) if model.interreflection else None
    return Surroundings(seen, None if sent is None else sent / (gauge.export_factor or 1.0))


def _write(stem: Path, radiance: np.ndarray, exposure: float, disc: bool = False) -> None:
    stem.parent.mkdir(parents=True, exist_ok=True)
    write_rgb_exr(stem.with_name(stem.name + ".exr"), radiance)
    pixels = picture(radiance, exposure)
    write_png(stem.with_name(stem.name + ".png"), _on_disc(pixels) if disc else pixels)


def _write_map(
    stem: Path, reflector: Reflector, material: Reflectance, normals: np.ndarray, exposure: float, size: int
) -> None:
    """Radiance by normal, and which normals the photo shows: ringed in the PNG."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    radiance, observed = ball(reflector, material, size), observed_cells(normals, size)
    channels = {c: radiance[..., k] for k, c in enumerate("RGB")}
    write_exr(stem.with_name(stem.name + ".exr"), {**channels, "observed": observed})
    pixels = picture(radiance, exposure)
    pixels[observed & ~binary_erosion(observed)] = RING
    write_png(stem.with_name(stem.name + ".png"), _on_disc(pixels))


def _on_disc(pixels: np.ndarray) -> np.ndarray:
    """Transparent beside the ball."""
    _, inside = ball_normals(len(pixels))
    return np.concatenate([pixels, 255 * inside[..., None].astype(np.uint8)], axis=-1)
