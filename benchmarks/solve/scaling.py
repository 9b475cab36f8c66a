"""Time of the solver of few lobes against the filled entries of the matrix: n × n, from 9 entries to 1600.

Small spheres (`PIXELS`² pixels each) rendered by the operator that solves them, under random lights of `LOBES` lobes, so
that only size grows.  The exponent is the slope of log time over log entries, by least squares.
"""

from __future__ import annotations

import msgspec
import numpy as np

from benchmarks.solve.clock import Clock
from benchmarks.solve.workers import threaded
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.reflection.operator import Operator
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.rounds import from_nothing
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.urm.observations import Observations

PIXELS, LOBES = 12, 6
SIDES = (3, 5, 10, 20, 40)
OPTIONS = FewLobes(lobes=12, insert=6, rounds=3, tolerance=1e-3)


def run(sides=SIDES, limit_s: float = 600.0) -> dict:
    """{"entries": {n²: {"wall", "processor"}}, "exponent": {…}}; no side is begun once `limit_s` of wall time are spent."""
    taken, clock = {}, Clock()
    for n in sides:
        if clock.taken().wall < limit_s:
            taken[str(n * n)] = msgspec.to_builtins(timed(n))
    return {"entries": taken, "exponent": {kind: exponent({int(k): v[kind] for k, v in taken.items()}) for kind in ("wall", "processor")}}


def timed(n: int):
    operator = reflection_operator("network")
    joint = JointProblem(problem(n, operator), operator, spread=threaded)
    clock = Clock()
    few_lobes(joint, from_nothing(n), Run(OPTIONS))
    return clock.taken()


def exponent(seconds: dict[int, float]) -> float | None:
    """Slope of log seconds over log entries.

    >>> round(exponent({10: 3.0, 100: 30.0, 1000: 300.0}), 6)
    1.0
    """
    if len(seconds) < 2:
        return None
    return float(np.polyfit(np.log(list(seconds)), np.log(list(seconds.values())), 1)[0])


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
    return msgspec.structs.replace(block, radiance=scaled, unit=float(radiance.mean()), precision=1 / np.hypot(0.05, 0.05 * scaled))
