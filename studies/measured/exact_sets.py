"""Exact sets: spheres whose normals are true and whose lights are maps, solved by the joint solver.

Materials and lights are those of the studies' world `SEED`; spheres are rendered by quadrature of the maps, not by the
operator that solves, with .2 % of noise.  `make results ONLY=exact_sets` (10 min of one core).
"""

import numpy as np

from factorlib.evaluate.ball import octahedral_light
from factorlib.evaluate.material_errors import common_factor
from factorlib.inference.blocks import Block, Noise
from factorlib.inference.fit_runner import Solution
from factorlib.inference.forward import Illumination
from factorlib.inference.joint_solver import solve
from factorlib.inference.observed import blocks_of_observations
from factorlib.inference.problem import JointProblem
from factorlib.inference.start import start_from_photos
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Reflectance
from factorlib.urm.merge import merge
from factorlib.urm.observations import concatenate
from studies.measured.tools import Clock, Tables, exact
from studies.spheres import light_map, materials_of, observations_of
from studies.study import Case

SEED = 31
SIZE = 72
NOISE = 0.002
MERGE_DEGREES = 2.0
MISSING = np.random.default_rng(SEED).random((5, 5)) < 0.4  # [material, light]
np.fill_diagonal(MISSING, False)
SETS: dict[str, dict[int, list[int]]] = {  # the materials in each light
    "3 × 3": {k: [0, 1, 2] for k in range(3)},
    "1 × 5": {k: [1] for k in range(5)},
    "5 × 1": {1: [0, 1, 2, 3, 4]},
    "5 × 5, 40 % missing": {k: [m for m in range(5) if not MISSING[m, k]] for k in range(5)},
}
HEAD = ["set", "processor, s", "k_d: mean, worst", "k_s: mean, worst", "roughness: mean, worst", "dB: mean, worst"]


def rows() -> Tables:
    """Return the errors on each set: materials after one factor a channel, pictures of all pixels without any."""
    materials = materials_of(SEED)
    table = [HEAD]
    operator = reflection_operator("network")
    lights = {li: octahedral_light(light_map(SEED, li, 128, 64)) for li in range(5)}
    for name, shown in SETS.items():
        case = Case(SEED, tuple((m, li) for li, some in shown.items() for m in some), SIZE, noise=NOISE)
        photos = observations_of(case, materials, lights).values()
        truth = [materials[n] for n in case.material_names]
        whole = blocks_of_observations(concatenate(list(photos)), Noise())
        blocks = blocks_of_observations(concatenate([merge(photo, MERGE_DEGREES) for photo in photos]), Noise())
        problem = JointProblem(blocks, operator)  # one thread: seconds are those of the work itself
        clock = Clock()
        solution = solve(problem, start_from_photos(len(truth)))
        seconds = f"{clock.taken().processor:.0f}"
        table.append([name, seconds, *_errors(solution, truth, problem, whole)])
        print(*table[-1], sep="; ", flush=True)
    return {"Exact sets": table}


def _errors(solution: Solution, truth: list[Reflectance], problem: JointProblem, whole: list[Block]) -> list[str]:
    of = solution.point.materials
    values = zip(of.diffuse.tolist(), of.specular.tolist(), of.roughness.tolist(), strict=True)
    own = [Reflectance(tuple(diffuse), tuple(specular), roughness) for diffuse, specular, roughness in values]
    factor = np.array(common_factor(own, truth))
    pairs = list(zip(own, truth, strict=True))
    shares = []
    for part in ("diffuse", "specular"):
        true = [np.array(getattr(b, part)) for _, b in pairs]
        off = [
            np.abs(np.array(getattr(a, part)) * factor - t).mean() / t.mean()
            for (a, _), t in zip(pairs, true, strict=True)
        ]
        shares.append(f"{100 * np.mean(off):.2g} %, {100 * max(off):.2g} %")
    rough = [abs(a.roughness - b.roughness) for a, b in pairs]
    decibels = []
    for block, solved, own_light in zip(whole, problem.blocks, solution.point.lights, strict=True):
        radiance = Illumination(block, own_light, of, problem.operator).radiance() * solved.unit / block.unit
        for m in np.unique(block.material):
            shown = radiance[block.material == m]
            expected = block.radiance[block.material == m]
            decibels.append(10 * np.log10(np.quantile(expected, 0.999) ** 2 / np.mean((shown - expected) ** 2)))
    return [*shares, f"{exact(np.mean(rough))}, {exact(max(rough))}", f"{np.mean(decibels):.1f}, {min(decibels):.1f}"]
