"""How far a method's predictions are from the truth: writes <case>.json, and into <case>/ pictures and shots.json.

photo-<material>-<light>.png is what was seen, <shot>.png a prediction, <shot>-truth.png the truth beside it; shots.json has their DSSIM.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.images.exr import read_rgb_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.baselines.answer import answer
from studies.core.baselines.case import Comparison, ShownShot, photo_name
from studies.core.baselines.photos import Photos, read_photos
from studies.core.baselines.score import Shot, World, score_of, shots
from studies.core.baselines.show import photo, shown
from studies.core.case import World as Lights
from studies.core.world import materials_of
from studies.steps.spheres.worlds import light_file


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: a metric that can be tuned is none."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with the truth."""
    case, lights = (
        msgspec.convert(inputs.facts[f"dataset.{name}"], of) for name, of in (("case", Comparison), ("worlds", Lights))
    )
    world = World(
        materials_of(case.seed),
        {li: read_rgb_exr(inputs["worlds"] / light_file(case.seed, li)) for li in range(lights.lights)},
    )
    photos = read_photos(case, inputs["observe"] / inputs.photo)
    prediction, seconds = answer(case, photos, _written(case, inputs), world.materials)
    found = shots(case, world, prediction)
    write_json(out / f"{inputs.photo}.json", score_of(world, prediction, found, seconds))
    _write_pictures(out / inputs.photo, photos, found)


def _written(case: Comparison, inputs: Inputs) -> Path:
    return inputs["optimise" if case.method == "mitsuba" else "solve"] / inputs.photo


def _write_pictures(out: Path, photos: Photos, found: list[Shot]) -> None:
    out.mkdir()
    for (material, light), radiance in photos.radiance.items():
        write_png(out / f"{photo_name(material, light)}.png", photo(photos.seen, radiance))
    for shot in found:
        for suffix, pixels in zip(("-truth", ""), shown(shot), strict=True):
            write_png(out / f"{shot.asked.name}{suffix}.png", pixels)
    write_json(out / "shots.json", [ShownShot(shot.asked, shot.dssim()) for shot in found])
