"""How far predictions are from photos that were not taken.

Three kinds of pictures of the body, each compared with the truth by DSSIM inside the body's outline, after the tone map of
`factorlib.evaluate.picture` at an exposure that takes the truth's white to 1:

    novel_view      every photographed entry, from `VIEWS`: the first shares a part of what it sees with the photo, the second little
    novel_light     every photographed material in the true lights of the world that no photo was taken in, from the photos' side
    novel_material  every material of the world that was not photographed, in the light of every photo, from the photos' side

each in the three gauges of `factorlib.evaluate.gauge`: nothing scaled beyond the one factor that no photo tells, which the true
materials fix; one number for all pictures of the kind (`_scaled`); one for each channel and picture (`_balanced`).

The rest are the errors of the reflectances that a method states, those of three spheres in the lights that it states, and the
processor seconds that it took.  What a method does not state has no score.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np

from factorlib.evaluate.ball import light_of_lat_long
from factorlib.evaluate.gauge import gauge_factors
from factorlib.evaluate.picture import picture_error, white_of
from factorlib.results.materials import Reflectance
from studies.core.baselines.body import Seen, seen, turn
from studies.core.baselines.case import Asked, Comparison
from studies.core.baselines.gauge import lambertian_part
from studies.core.baselines.prediction import Prediction
from studies.core.baselines.scene import Map, Radiance, Scene
from studies.core.case import Score, named
from studies.core.errors import PARTS, light_errors, material_errors

VIEWS = {"side": (70.0, 15.0), "back": (160.0, -10.0)}  # azimuth and elevation of the camera, degrees
FRONT = {"front": (0.0, 0.0)}  # the photos' own side
KINDS = ("novel_view", "novel_light", "novel_material")
SUFFIXES = {"none": "", "scalar_per_set": "_scaled", "channel_per_photo": "_balanced"}


class Shot(msgspec.Struct, frozen=True):
    """The true photo and the predicted one, as radiance of what is seen; white: radiance that both are shown with as white."""

    asked: Asked
    seen: Seen
    truth: Radiance
    predicted: Radiance
    white: float

    def dssim(self, factor: np.ndarray | float = 1.0) -> float:
        """Of the prediction times a factor."""
        pictures = (self.seen.picture(radiance) for radiance in (self.predicted * factor, self.truth))
        return picture_error(*pictures, self.seen.inside, self.white).dssim


class World(msgspec.Struct, frozen=True):
    """The truth: all materials by name and all lights by number, those that no photo shows among them."""

    materials: dict[str, Reflectance]
    lights: dict[int, Map]


def shots(case: Comparison, world: World, prediction: Prediction) -> list[Shot]:
    """All that is asked, and answered."""
    cameras = {name: seen(case.seed, case.size, turn(*at)) for name, at in (VIEWS | FRONT).items()}
    scenes = {(li, view): Scene(world.lights[li], camera) for li in world.lights for view, camera in cameras.items()}
    found = ((a, cameras[a.view], scenes[a.light, a.view].of(world.materials[a.material])) for a in asked(case, world))
    answered = ((a, camera, truth, _predicted(a, prediction, world, camera)) for a, camera, truth in found)
    return [
        Shot(a, camera, truth, p, white_of(camera.picture(truth), camera.inside))
        for a, camera, truth, p in answered
        if p is not None
    ]


def asked(case: Comparison, world: World) -> Iterator[Asked]:
    """Of a case."""
    names, first, unseen = list(world.materials), case.lights[0], sorted(world.lights.keys() - set(case.lights))
    yield from (Asked("novel_view", names[m], li, view, li) for view in VIEWS for m, li in case.entries)
    yield from (Asked("novel_light", name, li, "front", first) for name in case.material_names for li in unseen)
    yield from (
        Asked("novel_material", name, li, "front", None)
        for name in names
        if name not in case.material_names
        for li in case.lights
    )


def _predicted(a: Asked, by: Prediction, world: World, camera: Seen) -> Radiance | None:
    if a.kind == "novel_view":
        return by.new_view(a.material, a.light, camera)
    if a.kind == "novel_light":
        return by.new_light(a.material, world.lights[a.light], camera)
    return by.new_material(world.materials[a.material], a.light, camera)


def score_of(world: World, prediction: Prediction, found: list[Shot], seconds: float) -> Score:
    """found: of `shots`;  seconds: of the processor, that the answer took."""
    values = {}
    for kind in KINDS:
        of_kind = [shot for shot in found if shot.asked.kind == kind]
        values |= {kind + SUFFIXES[gauge]: error for gauge, error in _errors(of_kind).items()} if of_kind else {}
    return Score(values | {"processor": seconds}) | _of_materials(prediction, world) | _of_lights(prediction, world)


def _errors(found: list[Shot]) -> dict[str, float]:
    """Mean DSSIM in each gauge."""
    samples = [[getattr(shot, part) for shot in found] for part in ("predicted", "truth", "white")]
    factors = gauge_factors(*samples, below_white=True)
    return {
        gauge: float(np.mean([shot.dssim(f) for shot, f in zip(found, factor, strict=True)]))
        for gauge, factor in factors.items()
    }


def _of_materials(prediction: Prediction, world: World) -> Score:
    """Of a Lambertian method those of k_d alone, against the true k_d."""
    if not prediction.materials:
        return Score({})
    truths = lambertian_part(world.materials) if prediction.lambertian else world.materials
    return material_errors(
        prediction.materials,
        truths,
        dict.fromkeys(prediction.materials, 0),
        PARTS[:1] if prediction.lambertian else PARTS,
    )


def _of_lights(prediction: Prediction, world: World) -> Score:
    if not prediction.lights:
        return Score({})
    estimates, truths = (
        {li: light_of_lat_long(of[li]) for li in prediction.lights} for of in (prediction.lights, world.lights)
    )
    return light_errors(named(estimates), named(truths))
