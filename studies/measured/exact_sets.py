"""Exact sets: spheres whose normals are true and whose lights are maps, solved with cells and with few lobes in one run.

Materials and lights are those of the studies' world `SEED`; spheres are rendered by quadrature of the maps, not by the operator that solves,
with .2 % of noise.  `make results ONLY=exact_sets` (20 min of one core).
"""

from __future__ import annotations

import numpy as np

from factorlib.conventions import FRONT
from factorlib.evaluate.ball import ball, light_of_lat_long
from factorlib.evaluate.materials import common_factor
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Reflectance
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.history import Solution
from factorlib.solve.solve import solve
from factorlib.solve.start import from_nothing
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, concatenate
from studies.measured.tools import Clock, Tables, exact
from studies.spheres import in_camera, light_map, materials_of, sphere_normals

SEED, SIZE, NOISE, MERGE_DEGREES = 31, 72, 0.002, 2.0
MISSING = np.random.default_rng(SEED).random((5, 5)) < 0.4  # [material, light]
np.fill_diagonal(MISSING, False)
SETS: dict[str, dict[int, list[int]]] = {  # the materials in each light
    "3 × 3": {k: [0, 1, 2] for k in range(3)},
    "1 × 5": {k: [1] for k in range(5)},
    "5 × 1": {1: [0, 1, 2, 3, 4]},
    "5 × 5, 40 % missing": {k: [m for m in range(5) if not MISSING[m, k]] for k in range(5)},
}
HEAD = [
    "set",
    "solver",
    "processor, s",
    "k_d: mean, worst",
    "k_s: mean, worst",
    "roughness: mean, worst",
    "dB: mean, worst",
]


def rows() -> Tables:
    """The errors of both solvers on each set: materials after one factor a channel, pictures of all pixels without any."""
    materials = list(materials_of(SEED).values())
    table = [HEAD]
    for name, entries in SETS.items():
        used = sorted({m for shown in entries.values() for m in shown})
        photos = [
            _photo(k, [materials[m] for m in shown], [used.index(m) for m in shown]) for k, shown in entries.items()
        ]
        whole = blocks_of_observations(concatenate(photos), Noise())
        blocks = blocks_of_observations(concatenate([merge(photo, MERGE_DEGREES) for photo in photos]), Noise())
        problem = JointProblem(
            blocks, reflection_operator("network")
        )  # one thread: seconds are those of the work itself
        for solver in ("cells", "few lobes"):
            clock = Clock()
            cells = solver == "cells"
            solution = solve(problem, from_nothing(len(used))) if cells else few_lobes(problem, len(used))
            seconds = f"{clock.taken().processor:.0f}"
            table.append([name, solver, seconds, *_errors(solution, [materials[m] for m in used], problem, whole)])
            print(*table[-1], sep="; ", flush=True)
    return {"Cells and few lobes on exact sets": table}


def _photo(number: int, materials: list[Reflectance], labels: list[int]) -> Observations:
    normals, photo = sphere_normals(SIZE), (f"light_{number}",)
    light = light_of_lat_long(light_map(SEED, number, 128, 64))
    radiance = np.concatenate([ball(light, material, normals) for material in materials])
    radiance *= 1 + NOISE * np.random.default_rng([SEED, number]).standard_normal(radiance.shape)
    n = len(radiance)
    zero = np.zeros(n, int)
    return Observations(
        normal=np.tile(in_camera(normals), (len(materials), 1)), view=np.tile(FRONT, (n, 1)), radiance=radiance,
        clipped=np.zeros((n, 3), bool), material=np.repeat(labels, len(normals)), photo=zero, illumination=zero,
        x=np.arange(n), y=zero, weight=np.ones(n), materials=tuple("abcde"), photos=photo, illuminations=photo,
    )  # fmt: skip


def _errors(solution: Solution, truth: list[Reflectance], problem: JointProblem, whole: list[Block]) -> list[str]:
    of = solution.point.materials
    values = zip(of.diffuse.tolist(), of.specular.tolist(), of.roughness.tolist(), strict=True)
    own = [Reflectance(tuple(diffuse), tuple(specular), roughness) for diffuse, specular, roughness in values]
    factor = np.array(common_factor(own, truth))
    pairs = list(zip(own, truth, strict=True))
    kd, ks = (
        [
            np.abs(np.array(getattr(a, part)) * factor - getattr(b, part)).mean() / np.mean(getattr(b, part))
            for a, b in pairs
        ]
        for part in ("diffuse", "specular")
    )
    rough = [abs(a.roughness - b.roughness) for a, b in pairs]
    decibels = []
    for block, solved, own_light in zip(whole, problem.blocks, solution.point.lights, strict=True):
        radiance = Illumination(block, own_light, of, problem.operator).radiance() * solved.unit / block.unit
        for m in np.unique(block.material):
            shown, expected = radiance[block.material == m], block.radiance[block.material == m]
            decibels.append(10 * np.log10(np.quantile(expected, 0.999) ** 2 / np.mean((shown - expected) ** 2)))
    shares = [f"{100 * np.mean(e):.2g} %, {100 * max(e):.2g} %" for e in (kd, ks)]
    return [*shares, f"{exact(np.mean(rough))}, {exact(max(rough))}", f"{np.mean(decibels):.1f}, {min(decibels):.1f}"]
