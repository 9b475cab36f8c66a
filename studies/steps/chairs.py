"""Errors of the predicted chairs of a photo: writes <case>.json and <case>.png, the photo's chairs above these.

A chair is left out as the pixels of its shell in one photo; the rest of all photos is solved by the stage `solve`, for
each shell anew. Nothing is scaled in `chair`: the photo's exposure has to follow from the rest of it.  `chair_scaled`
takes one factor per channel out first.  The null is the shell's own mean colour, which nobody knows who has not seen
it; scaled or not, it is the same picture. Predicted pixels have the photo's shadows of meshes, but no light from other
surfaces where the chair is left out, for that light is read off the photo itself.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8

from factorlib.evaluate.picture_errors import picture_error, white_of
from factorlib.images.exr import read_exr
from factorlib.images.picture import picture, write_png
from factorlib.images.tone import shown
from factorlib.inference.interreflection import bounced_light
from factorlib.jsonfile import write_json
from factorlib.reflection import reflection_operator
from factorlib.render.reflect import Reflector
from factorlib.render.resynthesis import Surroundings, resynthesised
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import in_order, read_exposures, read_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import Observations, read_observations
from studies.steps import Params
from studies.steps.solve import solved
from studies.study import Score

LEGS = "wood"  # in all photos
MARGIN = 8  # pixels about a chair, in pictures
Image = Float[np.ndarray, "h w 3"]


class Photo(NamedTuple):
    """Photo of the set: its observations, and the channels that the stages `masks` and `align` write."""

    name: str
    table: Observations
    channels: Mapping[str, Any]
    geometry: Mapping[str, Any]


class Chair(msgspec.Struct, frozen=True):
    """The photo, and which of its pixels show a shell with a mesh below it."""

    truth: Image
    mask: Bool[np.ndarray, "h w"]

    @property
    def white(self) -> float:
        """The radiance that is shown as white."""
        return white_of(self.truth, self.mask)

    def beside(self, image: Image) -> UInt8[np.ndarray, "h w 3"]:
        """Return a picture of the photo's shell above that of another image, exposed alike."""
        rows, columns = (slice(max(at.min() - MARGIN, 0), at.max() + MARGIN) for at in np.nonzero(self.mask))
        pair = (picture(of[rows, columns], 1 / self.white) for of in (self.truth, image))
        return np.concatenate([np.where(self.mask[rows, columns][..., None], of, np.uint8(255)) for of in pair])


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve, predict, compare, and lay side by side."""
    case = inputs.facts["dataset.case"]
    (photos,) = inputs["photos"].iterdir()
    tables = {file.stem: read_observations(file) for file in sorted((photos / "urm").glob("*.parquet"))}
    channels = (read_exr(photos / stage / f"{case['photo']}.exr") for stage in ("masks", "align"))
    photo = Photo(case["photo"], tables[case["photo"]], *channels)
    chairs = {shell: chair_of(photo.table.materials.index(shell), photo) for shell in case["shells"]}
    alone = msgspec.structs.replace(inputs, unfinished=None)  # solves must not resume each other's
    images = []
    folder = Path()
    with TemporaryDirectory() as solves:
        for number, (shell, chair) in enumerate(chairs.items()):
            if case["prediction"] == "flat":
                colour = flat_colour(tables, photo.name, shell, LEGS)
                images.append(np.broadcast_to(colour, chair.truth.shape))
                continue
            observed = case["prediction"] == "observed"
            if not (observed and number):  # what is observed is solved once
                seen = tables if observed else tables | {photo.name: without(photo.table, shell)}
                (folder := Path(solves) / shell).mkdir()
                solved(seen, case["solve"], alone, folder, progress)
            images.append(predicted(folder, chair, photo, observed))
    write_json(out / f"{inputs.photo}.json", score_of(list(chairs.values()), images))
    write_png(
        out / f"{inputs.photo}.png", side_by_side([c.beside(of) for c, of in zip(chairs.values(), images, strict=True)])
    )


def without(table: Observations, material: str) -> Observations:
    """Return a photo's observations but for those of a material."""
    return table.take(table.material != table.materials.index(material))


def chair_of(label: int, photo: Photo) -> Chair:
    """Return the chair of a label."""
    channels = photo.channels
    mesh = np.abs(np.stack([photo.geometry[f"normal.{a}"] for a in "xyz"])).max(axis=0) > 0
    mask = (np.rint(channels["label"]) == label + 1) & (channels["valid"] > 0.5) & mesh
    return Chair(np.stack([channels[c] for c in "RGB"], axis=-1).astype(float), mask)


def flat_colour(tables: dict[str, Observations], photo: str, shell: str, beside: str) -> Float[np.ndarray, "3"]:
    """Return the shell's mean colour in the other photos, over that of `beside` there, times that of `beside` here.

    The result is RGB radiance.
    What can be said of a left-out chair without any model of light: `beside` (the wood of the legs) is in all photos.
    """

    def of(table: Observations, material: str) -> Float[np.ndarray, "n 3"]:
        """Return radiances of a material."""
        return table.radiance[table.material == table.materials.index(material)].astype(float)

    others = [t for name, t in tables.items() if name != photo and len(of(t, shell)) and len(of(t, beside))]
    ratio = np.mean([np.log(of(t, shell).mean(0) / of(t, beside).mean(0)) for t in others], axis=0)
    return of(tables[photo], beside).mean(0) * np.exp(ratio)


def predicted(folder: Path, chair: Chair, photo: Photo, bounces: bool) -> Image:
    """Predict the shell's pixels by a solve's materials and the photo's light, exposure and tone curve.

    Other pixels are zero.

    bounces: whether light that surfaces send each other is added, if the solve had it: it is read off the photo
    """
    answer = read_materials(folder / "materials.json")
    around = None
    exposure = np.array(read_exposures(folder / "exposures.json").get(photo.name, 1.0))
    lobes = read_lobes(folder / "lobes.parquet")[photo.name].scaled(exposure)
    if answer.model.self_shadowing:
        with_bounces = bounces and answer.model.interreflection
        sent = bounced_light(photo.table, photo.table.radiance.astype(float)) if with_bounces else None
        around = Surroundings(photo.table, sent)
    reflectances = in_order(answer, list(photo.table.materials), folder / "materials.json")
    alone = {**photo.channels, "label": np.where(chair.mask, photo.channels["label"], 0.0)}
    reflector = Reflector(reflection_operator("network"), lobes, curvature=answer.model.curvature(photo.name))
    image = resynthesised(reflector, reflectances, alone, photo.geometry, surroundings=around)
    tone = answer.model.tone.get(photo.name)
    return shown(image, tone.exponent, tone.pivot) if tone else image


def score_of(chairs: Sequence[Chair], images: Sequence[Image]) -> Score:
    """Return the mean over a photo's chairs."""
    pairs = list(zip(chairs, images, strict=True))
    flat = [(c, np.broadcast_to(c.truth[c.mask].mean(0), c.truth.shape)) for c in chairs]
    values = {"chair": _dssim(pairs), "chair_scaled": _dssim((c, image * _factor(c, image)) for c, image in pairs)}
    return Score(values, dict.fromkeys(values, _dssim(flat)))


def _dssim(pairs: Iterable[tuple[Chair, Image]]) -> float:
    return float(np.mean([picture_error(image, c.truth, c.mask, c.white).dssim for c, image in pairs]))


def _factor(chair: Chair, image: Image) -> Float[np.ndarray, "3"]:
    """Return the least-squares factor of each channel, over pixels that the photo's picture does not cut."""
    kept = chair.mask & (chair.truth.max(axis=2) <= chair.white)
    return (image[kept] * chair.truth[kept]).sum(0) / np.maximum((image[kept] ** 2).sum(0), 1e-30)


def side_by_side(pictures: Sequence[np.ndarray]) -> UInt8[np.ndarray, "h w 3"]:
    """Lay pictures in a row, white below the lower ones."""
    height = max(len(p) for p in pictures)
    padded = [np.pad(p, ((0, height - len(p)), (4, 4), (0, 0)), constant_values=255) for p in pictures]
    return np.concatenate(padded, axis=1)
