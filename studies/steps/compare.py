"""Errors of a method's predictions of photos that were not taken.

Writes <case>.json, and <case>.png with some of the predictions, the truth above each.

Three kinds of pictures of the sphere, each compared with the truth by DSSIM inside the sphere's outline, after the tone
map of `factorlib.evaluate.picture_errors` at an exposure that takes the truth's white to 1:

    novel_view      every photographed entry, from `VIEWS`: the first shares a part of what it sees with the photo, the
                    second little
    novel_light     every photographed material in the true lights of the world that no photo was taken in, from the
                    photos' side
    novel_material  every material of the world that was not photographed, in the light of every photo, from the photos'
                    side

each in the three gauges of `factorlib.evaluate.comparison_gauge`: nothing scaled beyond the one factor that no photo
tells, which the true materials fix; one number for all pictures of the kind (`_scaled`); one for each channel and
picture (`_balanced`).

The rest are the errors of the reflectances that a method states, those of three spheres in the lights that it states,
and the processor seconds that it took.  What a method does not state has no score.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from factorlib.evaluate.comparison_gauge import gauge_factors
from factorlib.evaluate.picture_errors import picture_error, white_of
from factorlib.images.exr import read_rgb_exr
from factorlib.images.picture import picture, write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.results.materials import Reflectance
from factorlib.stage import Inputs, Progress
from studies.body import Photos, Radiance, View, photographed, shown, turn, view
from studies.errors import PARTS, Map, in_gauge, light_errors, material_errors
from studies.methods import Prediction, grey, intrinsic, lambertian_part, projective, rendered
from studies.spheres import materials_of, read_maps
from studies.steps import Params
from studies.study import Comparison, Score
from studies.study import World as Lights

VIEWS = {"side": (70.0, 15.0), "back": (160.0, -10.0)}  # azimuth and elevation of the camera, degrees
FRONT = {"front": (0.0, 0.0)}  # the photos' own side
KINDS = ("novel_view", "novel_light", "novel_material")
SUFFIXES = {"none": "", "scalar_per_set": "_scaled", "channel_per_photo": "_balanced"}
INSTANT = {"projective": projective, "intrinsic": intrinsic, "grey": grey}  # methods that take less than a second
COLUMNS = 12  # pictures of <case>.png


class Shot(msgspec.Struct, frozen=True):
    """A photo that was not taken: what kind of prediction it asks for, of which material in which light, from where."""

    kind: str
    material: str
    light: int
    view: str


class Taken(msgspec.Struct, frozen=True):
    """The true photo and the predicted one, as radiance; white: radiance that both are shown with as white."""

    shot: Shot
    view: View
    truth: Radiance
    predicted: Radiance
    white: float

    def dssim(self, factor: np.ndarray | float = 1.0) -> float:
        """Return the DSSIM of the prediction times a factor."""
        pictures = (self.view.picture(radiance) for radiance in (self.predicted * factor, self.truth))
        return picture_error(*pictures, self.view.inside, self.white).dssim

    def picture(self, radiance: Radiance) -> np.ndarray:
        """Return 8-bit sRGB, white where there is nothing."""
        pixels = picture(self.view.picture(np.maximum(radiance, 0)), 1 / self.white)
        pixels[~self.view.inside] = 255
        return pixels


class World(msgspec.Struct, frozen=True):
    """The truth: all materials by name and all lights by number, those that no photo shows among them."""

    materials: dict[str, Reflectance]
    lights: dict[int, Map]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with the truth."""
    case = msgspec.convert(inputs.facts["dataset.case"], Comparison)
    numbers = range(msgspec.convert(inputs.facts["dataset.worlds"], Lights).lights)
    world = World(materials_of(case.seed), read_maps(inputs["worlds"], case.seed, numbers))
    photos, _ = photographed(case, world.materials, world.lights)
    prediction, seconds = answer(case, photos, inputs["answer"] / inputs.photo, world.materials)
    taken = shots(case, world, prediction)
    write_json(out / f"{inputs.photo}.json", score_of(world, prediction, taken, seconds))
    some = [taken[k] for k in np.unique(np.linspace(0, len(taken) - 1, COLUMNS).round().astype(int))]
    pairs = [np.concatenate([of.picture(of.truth), of.picture(of.predicted)]) for of in some]
    write_png(out / f"{inputs.photo}.png", np.concatenate(pairs, axis=1))


def answer(
    case: Comparison, photos: Photos, folder: Path, truths: Mapping[str, Reflectance]
) -> tuple[Prediction, float]:
    """Return a method's answer, and the processor seconds that it took.

    folder: what the step `answer` wrote, where it takes more than an instant
    """
    if case.method in INSTANT:
        start = time.process_time()
        return INSTANT[case.method](photos, truths), round(time.process_time() - start, 3)
    materials = msgspec.convert(read_json(folder / "materials.json"), dict[str, Reflectance])
    lights = {li: read_rgb_exr(folder / f"{li}.exr") for li in case.lights}
    return rendered(*in_gauge(materials, lights, truths)), read_json(folder / "seconds.json")


def shots(case: Comparison, world: World, prediction: Prediction) -> list[Taken]:
    """Return all shots that are asked, with what the method answers."""
    cameras = {name: view(case.size, turn(*at)) for name, at in (VIEWS | FRONT).items()}
    taken = []
    for shot in asked(case, world):
        camera = cameras[shot.view]
        material = world.materials[shot.material]
        light = world.lights[shot.light]
        truth = shown(material, light, camera)
        predicted = prediction.of(
            material if shot.kind == "novel_material" else shot.material,
            light if shot.kind == "novel_light" else shot.light,
            camera,
        )
        if predicted is not None:
            taken.append(Taken(shot, camera, truth, predicted, white_of(camera.picture(truth), camera.inside)))
    return taken


def asked(case: Comparison, world: World) -> Iterator[Shot]:
    """Yield what is asked of all methods in a case."""
    names = list(world.materials)
    unseen = sorted(world.lights.keys() - set(case.lights))
    others = [name for name in names if name not in case.material_names]
    yield from (Shot("novel_view", names[m], li, side) for side in VIEWS for m, li in case.entries)
    yield from (Shot("novel_light", name, li, "front") for name in case.material_names for li in unseen)
    yield from (Shot("novel_material", name, li, "front") for name in others for li in case.lights)


def score_of(world: World, prediction: Prediction, taken: Sequence[Taken], seconds: float) -> Score:
    """Score a method.

    taken: as `shots` makes them;  seconds: of the processor, that the answer took
    """
    score = Score({"processor": seconds})
    for kind in KINDS:
        if of_kind := [of for of in taken if of.shot.kind == kind]:
            samples = [[getattr(of, part) for of in of_kind] for part in ("predicted", "truth", "white")]
            for gauge, factors in gauge_factors(*samples, below_white=True).items():
                errors = [of.dssim(f) for of, f in zip(of_kind, factors, strict=True)]
                score |= Score({kind + SUFFIXES[gauge]: float(np.mean(errors))})
    if prediction.materials:  # of a Lambertian method k_d alone, against the true k_d
        truths = lambertian_part(world.materials) if prediction.lambertian else world.materials
        stated = PARTS[:1] if prediction.lambertian else PARTS
        score |= material_errors(prediction.materials, truths, dict.fromkeys(prediction.materials, 0), stated)
    return score | light_errors(prediction.lights, world.lights) if prediction.lights else score
