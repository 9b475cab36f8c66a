"""Illuminations at a wrong point that tests of the model and of its solvers share: spheres of known materials in lights of a few lobes."""

import msgspec
import numpy as np

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.model.blocks import Block
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.lights import Light
from factorlib.inference.model.materials import Point
from factorlib.inference.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Reflectance
from factorlib.scenes.joint_problems import (
    MATERIALS,
    observations_from_front,
    random_light,
    sphere_block,
    sphere_normals,
)
from factorlib.urm.observations import Observations
from tests.integral import reflected

OPERATOR = reflection_operator("closed_form", dtype="float64")


def none_held_out(block: Block) -> Block:
    """The same observations, none held out."""
    return msgspec.structs.replace(block, held_out=np.zeros(len(block), bool))


def guessed(rng: np.random.Generator, data, curves: bool) -> Illumination:
    """A block of two photos in a wrong light of four lobes, with tone curves or without."""
    guess, tone = random_light(rng, 4, photos=2), np.log([1.3, 0.8]) if curves else np.zeros(0)
    return Illumination(
        data, Light(guess.axis, guess.log_sharpness, guess.weight / 10, guess.log_exposure, tone), MATERIALS, OPERATOR
    )


def photos_in_a_wrong_light(kind: str, curves: bool = False) -> Illumination:
    """Observations of two photos: `clipped`, the brightest tenth of them; `bounced`, half of them reached by light from other surfaces;
    `hidden`, in a light fixed to the world, each photo hiding other directions."""
    rng = np.random.default_rng(1)
    size = 16 if kind == "clipped" else 14
    data = sphere_block("room", random_light(rng, 5, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=size)
    if kind == "clipped":
        clipped = data.radiance > np.quantile(data.radiance, 0.9)
        return guessed(
            rng, msgspec.structs.replace(data, clipped=clipped, radiance=np.minimum(data.radiance, 2.0)), curves
        )
    if kind == "bounced":
        bounced = rng.random((len(data), 6)) * (rng.random((len(data), 1)) < 0.5)
        return guessed(rng, msgspec.structs.replace(data, bounced=bounced), curves)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    directions = np.stack([fibonacci_sphere(96), fibonacci_sphere(96) @ turn.T])
    visibility = (rng.random((len(data), 96)) * 255).astype(np.uint8)
    one = guessed(rng, msgspec.structs.replace(data, visibility=visibility, directions=directions), curves)
    wide = msgspec.structs.replace(one.light, log_sharpness=np.minimum(one.light.log_sharpness, 3))
    return msgspec.structs.replace(one, light=wide)


def three_rooms() -> tuple[JointProblem, Point]:
    """Three materials in three lights, and a wrong point."""
    rng = np.random.default_rng(4)
    lights = [random_light(rng, 3) for _ in range(3)]
    blocks = [
        sphere_block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR, size=10) for k, light in enumerate(lights)
    ]
    guess = [random_light(rng, 4) for _ in range(3)]
    return JointProblem(blocks, OPERATOR), Point(
        MATERIALS, [msgspec.structs.replace(li, weight=li.weight / 10) for li in guess]
    )


def in_units_of(blocks: list[Block], lights: list[Light]) -> list[Light]:
    """Lights in the photos' radiance as lights in the units of their blocks."""
    return [msgspec.structs.replace(li, weight=li.weight / b.unit) for li, b in zip(lights, blocks, strict=True)]


def bowl_sees(normals, directions):
    """A ray from −n leaves the sphere at −n + 2(n·d)d; it is free where that lies before the rim."""
    exit_z = -normals[:, 2:] + 2 * (normals @ directions.T) * directions[:, 2]
    return (exit_z < 0) | (normals @ directions.T <= 0)


def traced(normals, sees, light: Light, material: int, count=12_000):
    """Radiance toward (0, 0, −1) by summing the light over `count` directions: no operator, no lobes."""
    d, row = fibonacci_sphere(count), MATERIALS.rows()[material]
    incoming = np.exp(light.sharpness * (d @ light.axis.T - 1)) @ light.weight * 4 * np.pi / count
    views, one = np.tile([0.0, 0.0, -1.0], (len(normals), 1)), Reflectance(row[:3], row[3:6], row[6])
    return reflected(one, normals, views, d, incoming, sees(normals, d))


def bowls(name, light, size=16, count=512) -> Observations:
    """A bowl and a ball of each material in one light."""
    normals, directions, parts, sees = sphere_normals(size), fibonacci_sphere(count), [], []
    for m in range(3):
        for seen in (bowl_sees, lambda n, d: np.ones((len(n), len(d)), bool)):
            parts.append(traced(normals, seen, light, m))
            sees.append(seen(normals, directions))
    material, visibility = np.repeat([0, 0, 1, 1, 2, 2], len(normals)), 255 * np.vstack(sees).astype(np.uint8)
    normal, names = np.tile(normals, (6, 1)), ("red", "green", "blue")
    return observations_from_front(normal, np.vstack(parts), material, names, name, visibility=visibility)


def rough_light(seed):
    light = random_light(np.random.default_rng(seed), 5)
    return msgspec.structs.replace(light, log_sharpness=np.minimum(light.log_sharpness, 3.5))
