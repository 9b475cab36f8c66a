"""Problems that differ in size alone: n materials in n lights, each pair a small sphere (`PIXELS`² pixels), rendered by the operator
that solves them, under random lights of `LOBES` lobes.
"""

from __future__ import annotations

import msgspec
import numpy as np

from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.reflection.operator import Operator
from factorlib.urm.observations import Observations

PIXELS, LOBES = 12, 6


def problem(n: int, operator: Operator, seed: int = 0) -> list[Block]:
    """n materials in n lights, each pair observed; others with another seed."""
    rng = np.random.default_rng([n, seed] if seed else n)
    gloss = rng.uniform(0.05, 0.4, n)
    materials = Materials(rng.uniform(0.05, 0.5, (n, 3)), np.repeat(gloss[:, None], 3, 1), rng.uniform(0.2, 0.7, n))
    return [lit(block, random_light(rng), materials, operator) for block in blocks_of_observations(spheres(n), Noise())]


def spheres(n: int) -> Observations:
    """Normals of an orthographic sphere for each pair, radiance yet unknown (1)."""
    y, x = (np.mgrid[:PIXELS, :PIXELS] + 0.5) / PIXELS * 2 - 1
    inside = x**2 + y**2 < 0.95
    normal = np.column_stack([x[inside], y[inside], -np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2)])
    k, total = len(normal), len(normal) * n * n
    names = tuple(f"{i:02d}" for i in range(n))
    light, material = np.repeat(np.arange(n), n * k), np.tile(np.repeat(np.arange(n), k), n)
    return Observations(
        normal=np.tile(normal, (n * n, 1)), view=np.tile([0.0, 0.0, -1.0], (total, 1)), radiance=np.ones((total, 3)),
        clipped=np.zeros((total, 3), bool), material=material, photo=light, illumination=light, x=np.arange(total), y=np.zeros(total, int),
        weight=np.ones(total), materials=names, photos=names, illuminations=names,
    )  # fmt: skip


def random_light(rng: np.random.Generator) -> Light:
    axis, log_sharpness = rng.normal(size=(LOBES, 3)), rng.uniform(0, 4.5, LOBES)
    weight = rng.lognormal(0, 0.7, (LOBES, 1)) * rng.lognormal(0, 0.2, (LOBES, 3)) * np.exp(log_sharpness / 2)[:, None]
    return Light(axis / np.linalg.norm(axis, axis=1, keepdims=True), log_sharpness, weight, np.zeros(1))


def lit(block: Block, light: Light, materials: Materials, operator: Operator) -> Block:
    """The block with the radiance of its light, mean 1."""
    radiance = Illumination(block, light, materials, operator).radiance()
    scaled = radiance / radiance.mean()
    return msgspec.structs.replace(
        block, radiance=scaled, unit=float(radiance.mean()), precision=1 / np.hypot(0.05, 0.05 * scaled)
    )
