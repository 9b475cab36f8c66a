"""Pictures of a score's spheres, for people: 8-bit sRGB, each exposed for its truth, with a rim of black."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from factorlib.evaluate.picture import white_of
from factorlib.images.picture import picture
from studies.core.score import Pictures

LARGER = 2  # times the pixels of a sphere
RIM = 3  # pixels


def column(pictures: Pictures, light: int, true: bool = False) -> UInt8[np.ndarray, "h w 3"]:
    """Spheres of the recovered materials, or of the true ones, one below the other, in a true light."""
    of = pictures.truths if true else pictures.answer.materials
    return np.concatenate(
        [shown(pictures, pictures.true[light].ball(of[n]), n, light) for n in pictures.case.material_names]
    )


def matrix(pictures: Pictures, true: bool = False) -> UInt8[np.ndarray, "h w 3"]:
    """All materials in all lights, recovered or true; entries that were observed have a bright frame."""
    case = pictures.case
    return np.concatenate(
        [np.concatenate([_cell(pictures, m, li, true) for li in case.lights], axis=1) for m in case.materials]
    )


def _cell(pictures: Pictures, material: int, light: int, true: bool) -> UInt8[np.ndarray, "h w 3"]:
    name = pictures.case.names[material]
    cell = shown(pictures, (pictures.truth if true else pictures.recovered)(name, light), name, light)
    if (material, light) in pictures.case.entries:
        cell[:2], cell[-2:], cell[:, :2], cell[:, -2:] = 200, 200, 200, 200
    return cell


def shown(pictures: Pictures, samples: Float[np.ndarray, "n 3"], name: str, light: int) -> UInt8[np.ndarray, "h w 3"]:
    """Radiance inside the disc as it looks beside the truth of that material in that light."""
    white = white_of(pictures.picture(pictures.truth(name, light)), pictures.inside)
    sphere = picture(pictures.picture(samples), 1 / white)
    return np.pad(sphere.repeat(LARGER, axis=0).repeat(LARGER, axis=1), ((RIM, RIM), (RIM, RIM), (0, 0)))
