"""What a seed stands for: materials, lights, and spheres of the ones in the others.

Materials  five, about those of `ABOUT`, each number times exp(.15 · normal).
Lights     by the project's own generator (`factorlib.generate`): the first of a world is a street by day, the others are rooms.
           Mean radiance 1.
Spheres    by quadrature of the lights' maps (`factorlib.evaluate.ball`), not by the operator that solves: what a solve
           is judged on is not made by its own approximations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.evaluate.ball import Light, ball, ball_normals, light_of_lat_long
from factorlib.generate.lights import random_light, random_materials
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import Material, look
from studies.core.case import NAMES

ABOUT = dict(
    zip(
        NAMES,
        (
            Material((0.5, 0.12, 0.1), (0.08, 0.08, 0.08), 0.6),
            Material((0.1, 0.35, 0.14), (0.25, 0.25, 0.25), 0.35),
            Material((0.12, 0.16, 0.24), (0.4, 0.4, 0.4), 0.22),
            Material((0.6, 0.58, 0.52), (0.04, 0.04, 0.04), 0.7),
            Material((0.15, 0.1, 0.04), (0.6, 0.45, 0.2), 0.3),
        ),
        strict=True,
    )
)
SPREAD = 0.15
GRAZING = 0.15  # n·o below which no pixel is seen


def materials_of(seed: int, about: dict[str, Material] = ABOUT) -> dict[str, Reflectance]:
    """The materials of a world by name."""
    drawn = random_materials(np.random.default_rng([11, seed]), SPREAD, about)
    return {name: Reflectance(m.diffuse, m.specular, m.roughness) for name, m in drawn.items()}


def light_map(seed: int, light: int, rows: int, spp: int) -> Float[np.ndarray, "h w 3"]:
    """Light number `light` of a world, lat-long in the camera's y-up frame, mean radiance 1; the same however many others there are."""
    rng = np.random.default_rng([12, seed, light])
    world_from_camera = look(rng.uniform(-14, -6), rng.uniform(0, 360))
    lamps = 1 + light % 2 if light else 0  # none: by day
    found = random_light(lamps, world_from_camera, [], rng, rows, spp)
    return (found / found.mean()).astype(np.float32)


def sphere_normals(size: int) -> Float[np.ndarray, "n 3"]:
    """Normals in the light's frame of a sphere `size` pixels across, seen orthographically; grazing ones are left out."""
    normals, _ = ball_normals(size)
    return normals[normals[:, 2] > GRAZING]


def spheres(
    materials: Sequence[Reflectance], light: Light, normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "m n 3"]:
    """Radiance of a sphere of each material, without noise."""
    return (
        np.stack([ball(light, material, normals) for material in materials])
        if len(materials)
        else np.zeros((0, len(normals), 3))
    )


def in_camera(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Normals of the light's frame in the camera's."""
    return normals @ YUP_FROM_CAMERA.T


def light(radiance: Float[np.ndarray, "h w 3"]) -> Light:
    """A map, ready to be reflected."""
    return light_of_lat_long(radiance)
