"""How far the predicted chairs of a photo are from the photo: writes <case>.json and chairs-<case>.png, the photo's above the predicted.

Nothing is scaled in `chair`: the photo's exposure has to follow from the rest of it.  `chair_scaled` takes one factor per channel
out first.  The null is the shell's own mean colour, which nobody knows who has not seen it; scaled or not, it is the same picture.
Predicted pixels have the photo's shadows of meshes, but no light from other surfaces where the chair is left out, for that light is read
off the photo itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8

from factorlib.evaluate.picture import picture_error, white_of
from factorlib.images.exr import read_exr
from factorlib.images.picture import picture, png_bytes, read_png, write_png
from factorlib.images.tone import shown
from factorlib.jsonfile import write_json
from factorlib.model.interreflection import bounced_light
from factorlib.reflection import reflection_operator
from factorlib.render.reflect import Reflector
from factorlib.render.resynthesis import Surroundings, resynthesised
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import in_order, read_exposures, read_materials
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import Observations, read_observations
from studies.steps import Params
from studies.study import Score, Setting, case_name

LEGS = "wood"  # in all photos
MARGIN = 8  # pixels about a chair, in pictures
Image = Float[np.ndarray, "h w 3"]


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
        rows, columns = (slice(max(at.min() - MARGIN, 0), at.max() + MARGIN) for at in np.nonzero(self.mask))
        colours = picture(image[rows, columns], 1 / self.white)
        return np.where(self.mask[rows, columns][..., None], colours, np.uint8(255))


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Predict, compare, and lay side by side."""
    case = inputs.facts["dataset.case"]
    (photos,) = inputs["photos"].iterdir()
    tables = {file.stem: read_observations(file) for file in sorted((photos / "urm").glob("*.parquet"))}
    materials = list(tables[case["photo"]].materials)
    channels, geometry = (read_exr(photos / stage / f"{case['photo']}.exr") for stage in ("masks", "align"))
    chairs = {shell: chair_of(case["photo"], materials.index(shell), channels, geometry) for shell in case["shells"]}

    def image(shell: str) -> Image:
        """What the case predicts."""
        if case["prediction"] == "flat":
            return np.broadcast_to(flat_colour(tables, case["photo"], shell, LEGS), chairs[shell].truth.shape)
        observed = case["prediction"] == "observed"
        solved = inputs["whole"] if observed else inputs["leave_out"] / inputs.photo / shell
        return predicted(solved, chairs[shell], materials, channels, geometry, tables[case["photo"]], observed)

    images = {shell: image(shell) for shell in chairs}
    write_json(out / f"{inputs.photo}.json", score_of(list(chairs.values()), list(images.values())))
    pairs = [np.concatenate([c.cut_out(c.truth), c.cut_out(images[shell])]) for shell, c in chairs.items()]
    write_png(out / f"chairs-{inputs.photo}.png", np.concatenate(level(pairs), axis=1))


def chair_of(photo: str, label: int, channels: Mapping[str, Any], geometry: Mapping[str, Any]) -> Chair:
    """channels, geometry: as the stages `masks` and `align` write them."""
    mesh = np.abs(np.stack([geometry[f"normal.{a}"] for a in "xyz"])).max(axis=0) > 0
    mask = (np.rint(channels["label"]) == label + 1) & (channels["valid"] > 0.5) & mesh
    return Chair(photo, np.stack([channels[c] for c in "RGB"], axis=-1).astype(float), mask)


def flat_colour(tables: dict[str, Observations], photo: str, shell: str, beside: str) -> Float[np.ndarray, "3"]:
    """The shell's mean colour in the other photos, over that of `beside` there, times that of `beside` here: RGB radiance.

    What can be said of a left-out chair without any model of light: `beside` (the wood of the legs) is in all photos.
    """

    def of(table: Observations, material: str) -> Float[np.ndarray, "n 3"]:
        """Radiances of a material."""
        return table.radiance[table.material == table.materials.index(material)].astype(float)

    others = [t for name, t in tables.items() if name != photo and len(of(t, shell)) and len(of(t, beside))]
    ratio = np.mean([np.log(of(t, shell).mean(0) / of(t, beside).mean(0)) for t in others], axis=0)
    return of(tables[photo], beside).mean(0) * np.exp(ratio)


def predicted(
    solved: Path, chair: Chair, materials: list[str], channels: Mapping[str, Any], geometry: Mapping[str, Any],
    table: Observations, bounces: bool,
) -> Image:  # fmt: skip
    """The shell's pixels by the materials, the photo's light, its exposure and its tone curve of a solve; zero elsewhere.

    bounces: whether light that surfaces send each other is added, if the solve had it: it is read off the photo
    """
    answer, around = read_materials(solved / "materials.json"), None
    exposure = np.array(read_exposures(solved / "exposures.json").get(chair.photo, 1.0))
    lobes = read_lobes(solved / "lobes.parquet")[chair.photo].scaled(exposure)
    if answer.model.self_shadowing:
        with_bounces = bounces and answer.model.interreflection
        around = Surroundings(table, bounced_light(table, table.radiance.astype(float)) if with_bounces else None)
    reflectances = in_order(answer, materials, solved / "materials.json")
    alone = {**channels, "label": np.where(chair.mask, channels["label"], 0.0)}
    reflector = Reflector(reflection_operator("network"), lobes)
    image = resynthesised(reflector, reflectances, alone, geometry, around=around)
    tone = answer.model.tone.get(chair.photo)
    return shown(image, tone.exponent, tone.pivot) if tone else image


def score_of(chairs: Sequence[Chair], images: Sequence[Image]) -> Score:
    """The mean over a photo's chairs."""
    pairs = list(zip(chairs, images, strict=True))
    flat = [(c, np.broadcast_to(c.truth[c.mask].mean(0), c.truth.shape)) for c in chairs]
    values = {"chair": _dssim(pairs), "chair_scaled": _dssim((c, image * _factor(c, image)) for c, image in pairs)}
    return Score(values, dict.fromkeys(values, _dssim(flat)))


def _dssim(pairs: Iterable[tuple[Chair, Image]]) -> float:
    return float(np.mean([picture_error(image, c.truth, c.mask, c.white).dssim for c, image in pairs]))


def _factor(chair: Chair, image: Image) -> Float[np.ndarray, "3"]:
    """The least-squares factor of each channel, over pixels that the photo's picture does not cut."""
    kept = chair.mask & (chair.truth.max(axis=2) <= chair.white)
    return (image[kept] * chair.truth[kept]).sum(0) / np.maximum((image[kept] ** 2).sum(0), 1e-30)


def level(pictures: Sequence[np.ndarray], above: bool = False) -> list[np.ndarray]:
    """Pictures padded with white to the height of the highest, below or `above`."""
    height = max(len(p) for p in pictures)
    sides = [(height - len(p), 0) if above else (0, height - len(p)) for p in pictures]
    return [np.pad(p, (side, (0, 0), (0, 0)), constant_values=255) for p, side in zip(pictures, sides, strict=True)]


def side_by_side(pictures: Sequence[np.ndarray]) -> UInt8[np.ndarray, "h w 3"]:
    """Pairs of equally high halves in a row, so that the lower halves begin at the same height."""
    spaced = [np.pad(p, ((0, 0), (4, 4), (0, 0)), constant_values=255) for p in pictures]
    halves = [
        level([half(p) for p in spaced], above=True)
        for half in (lambda p: p[: len(p) // 2], lambda p: p[len(p) // 2 :])
    ]
    return np.concatenate([np.concatenate(row, axis=1) for row in halves])


def shells_of_photos(settings: Sequence[Setting], numbers: Sequence[int], scores: Path) -> dict[str, tuple[str, bytes]]:
    """PNG files by name, with captions: the photos' shells above the predicted ones, a file for each setting."""
    files = {}
    for s in settings:
        shells = ", ".join(f"{s.case(k).photo} ({', '.join(s.case(k).shells)})" for k in numbers)
        caption = f"{s.label}: the chairs' shells in the photos (above) and predicted (below), exposed alike: {shells}."
        pictures = [read_png(scores / f"chairs-{case_name(s.name, k)}.png") for k in numbers]
        files[f"{s.name}.png"] = (caption, png_bytes(side_by_side(pictures)))
    return files
