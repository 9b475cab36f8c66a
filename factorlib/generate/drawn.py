"""What is drawn at random for a set: its materials and its lights.

Nothing here needs a mesh, so studies of spheres need not load the libraries for meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.generate import lights
from factorlib.generate.lights import SceneDict
from factorlib.tracing.scene import Material, light_seen, rigid

MATERIALS = {
    "red": Material((0.5, 0.12, 0.1), (0.08, 0.08, 0.08), 0.6),
    "green": Material((0.1, 0.35, 0.14), (0.25, 0.25, 0.25), 0.35),
    "blue": Material((0.12, 0.16, 0.24), (0.4, 0.4, 0.4), 0.22),
}


def drawn_materials(
    rng: np.random.Generator, spread: float, about: dict[str, Material] = MATERIALS
) -> dict[str, Material]:
    """The materials of `about`, each number times exp(spread · normal), within k_d + k_s ≤ 0.95."""
    drawn = {}
    for name, material in about.items():
        factor = np.exp(spread * rng.standard_normal(5))
        diffuse = np.array(material.diffuse) * factor[:3]
        specular = np.array(material.specular) * factor[3]
        shrink = min(1.0, 0.95 / (diffuse.max() + specular.max()))
        roughness = float(np.clip(material.roughness * factor[4], 0.15, 0.8))
        drawn[name] = Material(_rounded(diffuse * shrink), _rounded(specular * shrink), round(roughness, 4))
    return drawn


def _rounded(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(round(float(v), 4) for v in values)


def drawn_light(
    number: int,
    world_from_camera: Float[np.ndarray, "3 3"],
    lat_longs: Sequence[Path],
    rng: np.random.Generator,
    rows: int,
    spp: int,
) -> Float[np.ndarray, "h w 3"]:
    """The light of photo `number`, in the camera's y-up frame: daylight for the first, rooms for the others.

    lat_longs: maps that replace them;  rows, spp: of the map, and samples a pixel
    """
    if lat_longs:
        return lights.captured(lat_longs[number % len(lat_longs)], rows)
    seed = int(rng.integers(1 << 24))
    turn = world_from_camera @ YUP_FROM_CAMERA
    scene = surroundings(number, world_from_camera, rng, 2 * rows)
    return light_seen(scene, rigid(turn, (0, 0, 0)), rows, spp, seed)


def surroundings(
    number: int, world_from_camera: Float[np.ndarray, "3 3"], rng: np.random.Generator, sky_rows: int
) -> SceneDict:
    """Light number 0 is a street by day, the others rooms with as many lamps as their number.

    The sun stands behind the camera, to its left or right.
    """
    if number:
        return lights.room(rng, windows=2, lamps=number)
    forward = np.degrees(np.arctan2(world_from_camera[0, 2], world_from_camera[2, 2]))
    return lights.daylight(
        rng, rng.uniform(30, 50), forward + 180 + rng.choice([-1, 1]) * rng.uniform(35, 70), rows=sky_rows
    )
