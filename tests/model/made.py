"""Illuminations at a wrong point that tests of the model and of its solvers share: spheres of known materials in lights of a few lobes."""

import msgspec
import numpy as np

from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("closed_form", dtype="float64")


def guessed(rng: np.random.Generator, data, curves: bool) -> Illumination:
    """A block of two photos in a wrong light of four lobes, with tone curves or without."""
    guess, tone = random_light(rng, 4, photos=2), np.log([1.3, 0.8]) if curves else np.zeros(0)
    return Illumination(
        data, Light(guess.axis, guess.log_sharpness, guess.weight / 10, guess.log_exposure, tone), MATERIALS, OPERATOR
    )


def clipped_photos(curves: bool) -> Illumination:
    """Observations of two photos, the brightest tenth of them clipped, in a wrong light."""
    rng = np.random.default_rng(1)
    data = block("room", random_light(rng, 5, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=16)
    clipped = data.radiance > np.quantile(data.radiance, 0.9)
    return guessed(rng, msgspec.structs.replace(data, clipped=clipped, radiance=np.minimum(data.radiance, 2.0)), curves)


def bounced_photos(curves: bool) -> Illumination:
    """Observations of two photos, half of them reached by light from other surfaces, in a wrong light."""
    rng = np.random.default_rng(1)
    data = block("room", random_light(rng, 5, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=14)
    bounced = rng.random((len(data), 6)) * (rng.random((len(data), 1)) < 0.5)
    return guessed(rng, msgspec.structs.replace(data, bounced=bounced), curves)


def three_rooms() -> tuple[JointProblem, Point]:
    """Three materials in three lights, and a wrong point."""
    rng = np.random.default_rng(4)
    lights = [random_light(rng, 3) for _ in range(3)]
    blocks = [
        block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR, size=10, seed=k) for k, light in enumerate(lights)
    ]
    guess = [random_light(rng, 4) for _ in range(3)]
    return JointProblem(blocks, OPERATOR), Point(
        MATERIALS, [msgspec.structs.replace(li, weight=li.weight / 10) for li in guess]
    )
