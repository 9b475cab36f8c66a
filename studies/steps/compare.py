"""Errors of a method's predictions of photos that were not taken: writes <case>.json.

Three kinds of pictures of the sphere, each compared with the truth by DSSIM inside the sphere's outline, after the tone
map of `factorlib.evaluate.picture_errors` at an exposure that takes the truth's white to 1:

    novel_view      every photographed entry, from its side, a part of which is in the photo, and from its back, little
                    of which is
    novel_light     every photographed material in the true lights of the world that no photo was taken in, from the
                    photos' side
    novel_material  every material of the world that was not photographed, in the light of every photo, from the photos'
                    side

each in the three gauges of `factorlib.evaluate.comparison_gauge`: nothing scaled beyond the one factor that no photo
tells, which the true materials fix; one number for all pictures of the kind (`_scaled`); one for each channel and
picture (`_balanced`).

The rest are the errors of the reflectances that a method states, those of three spheres in the lights that it states,
and its processor seconds.  What a method does not state has no score.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from factorlib.evaluate.comparison_gauge import gauge_factors
from factorlib.evaluate.picture_errors import picture_error, white_level
from factorlib.jsonfile import read_json, write_json
from factorlib.results.materials import read_materials
from factorlib.stage import Inputs, Progress
from studies.baselines import MethodPrediction, predict_by_projection, predict_by_rendering, predict_grey
from studies.recovery_errors import PARTS, Materials, in_gauge, light_errors, material_errors, read_recovered_maps
from studies.spheres import Maps, Radiance, SphereView, materials_of, photograph, read_maps, sphere_view
from studies.steps import Params
from studies.study import Comparison, Score, World

VIEWS = {"side": (70.0, 15.0), "back": (160.0, -10.0), "front": (0.0, 0.0)}  # azimuth, elevation of a camera, degrees
KINDS = ("novel_view", "novel_light", "novel_material")
SUFFIXES = {"none": "", "scalar_per_set": "_scaled", "channel_per_photo": "_balanced"}
INSTANT = {"projective": predict_by_projection, "grey": predict_grey}  # methods that take less than a second


class UnseenPhoto(msgspec.Struct, frozen=True):
    """A photo that was not taken: the kind of prediction, the material, the light, and the side it is seen from."""

    kind: str
    material: str
    light: int
    side: str


class PredictedPhoto(msgspec.Struct, frozen=True):
    """The true picture of a target and the predicted one, as radiance; white: radiance that is shown as white."""

    target: UnseenPhoto
    view: SphereView
    truth: Radiance
    predicted: Radiance
    white: float

    def dssim(self, factor: np.ndarray | float = 1.0) -> float:
        """Return the DSSIM of the prediction times a factor."""
        pictures = (self.view.picture(radiance) for radiance in (self.predicted * factor, self.truth))
        return picture_error(*pictures, self.view.inside, self.white).dssim


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare the predictions of a method with the true pictures, and write the scores."""
    case = msgspec.convert(inputs.facts["dataset.case"], Comparison)
    numbers = range(msgspec.convert(inputs.facts["dataset.worlds"], World).lights)
    truths = materials_of(case.seed)
    maps = read_maps(inputs["worlds"], case.seed, numbers)
    folder = inputs["solve"] / inputs.photo
    if case.method in INSTANT:
        photos, _ = photograph(case, truths, maps)
        start_s = time.process_time()
        prediction = INSTANT[case.method](photos, truths)
        seconds = round(time.process_time() - start_s, 3)
    else:
        solved = {n: m.reflectance for n, m in read_materials(folder / "materials.json").materials.items()}
        prediction = predict_by_rendering(*in_gauge(solved, read_recovered_maps(folder, case.lights), truths))
        seconds = read_json(folder / "measured.json")["seconds"]
    pictures = predict(case, truths, maps, prediction)
    write_json(
        out / f"{inputs.photo}.json", Score({"processor": seconds}) | score_method(truths, maps, prediction, pictures)
    )


def predict(case: Comparison, truths: Materials, maps: Maps, prediction: MethodPrediction) -> list[PredictedPhoto]:
    """Return the pictures of all targets that the method predicts."""
    cameras = {side: sphere_view(case.size, *angles) for side, angles in VIEWS.items()}
    pictures = []
    for target in targets(case, truths, maps):
        view = cameras[target.side]
        material = truths[target.material]
        light = maps[target.light]
        truth = view.render(material, light)
        predicted = prediction.render(
            material if target.kind == "novel_material" else target.material,
            light if target.kind == "novel_light" else target.light,
            view,
        )
        if predicted is not None:
            pictures.append(
                PredictedPhoto(target, view, truth, predicted, white_level(view.picture(truth), view.inside))
            )
    return pictures


def targets(case: Comparison, truths: Materials, maps: Maps) -> Iterator[UnseenPhoto]:
    """Yield the targets of a case, the same for all methods."""
    names = list(truths)
    yield from (UnseenPhoto("novel_view", names[m], li, side) for side in ("side", "back") for m, li in case.entries)
    unobserved = sorted(maps.keys() - set(case.lights))
    yield from (UnseenPhoto("novel_light", name, li, "front") for name in case.material_names for li in unobserved)
    others = [name for name in names if name not in case.material_names]
    yield from (UnseenPhoto("novel_material", name, li, "front") for name in others for li in case.lights)


def score_method(truths: Materials, maps: Maps, prediction: MethodPrediction, pictures: list[PredictedPhoto]) -> Score:
    """Score a method by its pictures, and by the materials and lights that it states."""
    score = Score({})
    for kind in KINDS:
        if group := [picture for picture in pictures if picture.target.kind == kind]:
            samples = [[getattr(picture, part) for picture in group] for part in ("predicted", "truth", "white")]
            for gauge, factors in gauge_factors(*samples, below_white=True).items():
                errors = [picture.dssim(factor) for picture, factor in zip(group, factors, strict=True)]
                score |= Score({kind + SUFFIXES[gauge]: float(np.mean(errors))})
    if materials := prediction.materials:  # of a Lambertian method k_d alone
        parts = PARTS if any(any(m.specular) for m in materials.values()) else PARTS[:1]
        score |= material_errors(materials, truths, dict.fromkeys(materials, 0), parts)
    return score | light_errors(prediction.lights, maps) if prediction.lights else score
