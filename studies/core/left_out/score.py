"""A predicted chair beside the photo's: pictures of the shell's pixels, and how far they are apart.

Nothing is scaled in `chair`: the photo's exposure has to follow from the rest of it.  `chair_scaled` takes one factor per channel
out first.  The null is the shell's own mean colour, which nobody knows who has not seen it; scaled or not, it is the same picture.
Predicted pixels have the photo's shadows of meshes, but no light from other surfaces where the chair is left out, for that light is read
off the photo itself.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8

from factorlib.evaluate.picture import picture_error, white_of
from factorlib.images.exr import read_exr
from factorlib.images.picture import picture
from factorlib.images.tone import shown
from factorlib.model.interreflection import bounced_light
from factorlib.reflection import reflection_operator
from factorlib.render.reflect import Reflector
from factorlib.render.resynthesis import Surroundings, resynthesised
from factorlib.results.exposures import read_exposures
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import in_order, read_materials
from factorlib.urm.observations import read_observations
from studies.core.case import Score

Image = Float[np.ndarray, "h w 3"]
MARGIN = 8  # pixels about a chair, in pictures


class Chair(msgspec.Struct, frozen=True):
    """The photo, and which of its pixels show a shell with a mesh below it."""

    photo: str
    truth: Image
    mask: Bool[np.ndarray, "h w"]

    @property
    def white(self) -> float:
        """The radiance that is shown as white."""
        return white_of(self.truth, self.mask)

    def cut_out(self, image: Image) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of the shell alone, exposed as the photo's."""
        rows, columns = np.nonzero(self.mask)
        box = np.s_[
            max(rows.min() - MARGIN, 0) : rows.max() + MARGIN, max(columns.min() - MARGIN, 0) : columns.max() + MARGIN
        ]
        return np.where(self.mask[box][..., None], picture(image[box], 1 / self.white), np.uint8(255))


def chair_of(photos: Path, photo: str, shell: str, materials: list[str]) -> Chair:
    """photos: the folder that `photos.observe` wrote."""
    channels, geometry = (read_exr(photos / stage / f"{photo}.exr") for stage in ("masks", "align"))
    mesh = np.abs(np.stack([geometry[f"normal.{a}"] for a in "xyz"])).max(axis=0) > 0
    mask = (np.rint(channels["label"]) == materials.index(shell) + 1) & (channels["valid"] > 0.5) & mesh
    return Chair(photo, np.stack([channels[c] for c in "RGB"], axis=-1).astype(float), mask)


def predicted(photos: Path, solved: Path, chair: Chair, materials: list[str], bounces: bool) -> Image:
    """The shell's pixels by the materials, the photo's light, its exposure and its tone curve of a solve; zero elsewhere.

    bounces: whether light that surfaces send each other is added, if the solve had it: it is read off the photo
    """
    table = read_materials(solved / "materials.json")
    channels, geometry = (read_exr(photos / stage / f"{chair.photo}.exr") for stage in ("masks", "align"))
    exposure = np.array(read_exposures(solved / "exposures.json").get(chair.photo, 1.0))
    lobes = read_lobes(solved / "lobes.parquet")[chair.photo].scaled(exposure)
    around = None
    if table.model.self_shadowing:
        seen = read_observations(photos / "urm" / f"{chair.photo}.parquet")
        sent = bounced_light(seen, seen.radiance.astype(float)) if bounces and table.model.interreflection else None
        around = Surroundings(seen, sent)
    reflectances = in_order(table, materials, solved / "materials.json")
    alone = {**channels, "label": np.where(chair.mask, channels["label"], 0.0)}
    found = resynthesised(
        Reflector(reflection_operator("network"), lobes), reflectances, alone, geometry, around=around
    )
    tone = table.model.tone.get(chair.photo)
    return shown(found, tone.exponent, tone.pivot) if tone else found


def score_of(chairs: list[Chair], images: list[Image]) -> Score:
    """The mean over a photo's chairs."""
    pairs = list(zip(chairs, images, strict=True))
    values = {
        "chair": [_dssim(chair, image) for chair, image in pairs],
        "chair_scaled": [_dssim(chair, image * _factor(chair, image)) for chair, image in pairs],
    }
    null = float(
        np.mean(
            [_dssim(chair, np.broadcast_to(chair.truth[chair.mask].mean(0), chair.truth.shape)) for chair in chairs]
        )
    )
    return Score({name: float(np.mean(of)) for name, of in values.items()}, dict.fromkeys(values, null))


def _dssim(chair: Chair, image: Image) -> float:
    return picture_error(image, chair.truth, chair.mask, chair.white).dssim


def _factor(chair: Chair, image: Image) -> Float[np.ndarray, "3"]:
    """The least-squares factor of each channel, over pixels that the photo's picture does not cut."""
    kept = chair.mask & (chair.truth.max(axis=2) <= chair.white)
    found, truth = image[kept], chair.truth[kept]
    return (found * truth).sum(0) / np.maximum((found**2).sum(0), 1e-30)
