"""The hard cases of the joint solve: what is seen, what is true, and how far the answer is from it.

Observations of spheres under lights made of a few lobes, rendered by the operator that solves, go the way of the stage:
`blocks_of_observations`, `solve`, standard errors.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import Bundle, Joint, solve
from factorlib.solve.normal_equations import predicted_radiance
from factorlib.solve.problem import Block, Noise, blocks_of_observations, connected_components
from factorlib.solve.unknowns import Light, Materials
from factorlib.stage import serial_map
from factorlib.urm.observations import Observations
from tests.solve.problems import sphere_normals

OPERATOR = reflection_operator("network")
QUICK = Bundle(lobes=8, insert=4, rounds=3, iterations=8, polish=20, tolerance=1e-4)
TRUTH = Materials(
    diffuse=np.array([[0.5, 0.1, 0.1], [0.2, 0.4, 0.25], [0.1, 0.12, 0.2], [0.3, 0.3, 0.05], [0.25, 0.2, 0.3]]),
    specular=np.array([[0.05, 0.05, 0.05], [0.2, 0.2, 0.2], [0.4, 0.35, 0.3], [0.1, 0.1, 0.1], [0.3, 0.3, 0.3]]),
    roughness=np.array([0.7, 0.4, 0.25, 0.5, 0.3]),
)
NAMES = ("red", "green", "blue", "yellow", "violet")
FRONT = np.array([0.0, 0.0, -1.0])


class Answer(msgspec.Struct, frozen=True):
    """What came out of a case.

    k:         mean error of diffuse and specular reflectance over the mean of their sum, after one factor per channel and component
    roughness: largest error
    seen:      RMS error of the radiance of the noiseless observations, over their mean
    """

    k: float
    roughness: float
    seen: float
    joint: Joint
    blocks: list[Block]

    @property
    def materials(self) -> Materials:
        return self.joint.solution.materials

    def finite(self) -> bool:
        arrays = [self.materials.vector()]
        for light in self.joint.solution.lights:
            arrays += [light.axis, light.log_sharpness, light.weight, light.log_exposure]
        return all(np.isfinite(array).all() for array in arrays)


def lamps(seed: int, lobes: int = 3, sharpness=(0.5, 60.0)) -> Light:
    """A broad lobe and a few lamps."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(lobes, 3)) + FRONT
    log_sharpness = np.concatenate([[np.log(sharpness[0])], np.log(sharpness[1]) * rng.uniform(0.5, 1, lobes - 1)])
    weight = rng.lognormal(0, 0.3, (lobes, 1)) * rng.lognormal(0, 0.1, (lobes, 3)) * np.exp(log_sharpness * 0.8)[:, None]
    return Light(axis / np.linalg.norm(axis, axis=1, keepdims=True), log_sharpness, weight, np.zeros(1))


def observed(truth: Materials, lights: Sequence[Light], shown: Sequence[Sequence[int]], normals=None, view=FRONT) -> Observations:
    """A sphere, or any `normals`, of each material that photo i shows, in light i."""
    normals = sphere_normals(14) if normals is None else normals
    parts = [(i, m) for i, materials in enumerate(shown) for m in materials]
    n, count = len(normals), len(parts)
    names = tuple(f"room{i}" for i in range(len(lights)))
    empty = Observations(
        normal=np.tile(normals, (count, 1)), view=np.tile(view, (n * count, 1)), radiance=np.ones((n * count, 3)),
        clipped=np.zeros((n * count, 3), bool), material=np.repeat([m for _, m in parts], n), photo=np.repeat([i for i, _ in parts], n),
        illumination=np.repeat([i for i, _ in parts], n), x=np.arange(n * count), y=np.zeros(n * count, int), weight=np.ones(n * count),
        materials=NAMES[: len(truth)], photos=names, illuminations=names,
    )  # fmt: skip
    radiance = np.ones((n * count, 3))
    for block in blocks_of_observations(empty, Noise(), held_out=0.0):
        i = names.index(block.name)
        order = np.flatnonzero(empty.illumination == i)
        order = order[np.lexsort((empty.x[order], empty.y[order], empty.photo[order], empty.material[order]))]
        radiance[order] = predicted_radiance(block, lights[i], truth, OPERATOR)
    return msgspec.structs.replace(empty, radiance=radiance)


def solved(seen: Observations, truth: Materials, clean: Observations | None = None, bundle: Bundle = QUICK, operator=OPERATOR) -> Answer:
    """The answer, held against the `clean` observations (default: those that were seen)."""
    blocks = blocks_of_observations(seen, Noise(), seed=bundle.seed)
    joint = solve(blocks, len(truth), operator, bundle, serial_map, lambda event: None)
    found = joint.solution
    k, roughness = material_errors(found.materials, truth, blocks)
    return Answer(k, roughness, reseen(joint, blocks, seen if clean is None else clean, operator), joint, blocks)


def material_errors(found: Materials, truth: Materials, blocks: Sequence[Block]) -> tuple[float, float]:
    """Errors of reflectance and roughness, of the materials that were seen."""
    errors, of, rough = [], [], []
    for members, lights in connected_components(blocks, len(truth)):
        rows = list(members)
        if not lights:
            continue
        f, t = (np.stack([m.diffuse[rows], m.specular[rows]]) for m in (found, truth))
        factor = t.sum((0, 1)) / f.sum((0, 1))
        errors.append(np.abs(f * factor - t).ravel())
        of.append(t.sum(0).ravel())
        rough.append(np.abs(found.roughness[rows] - truth.roughness[rows]))
    return float(np.concatenate(errors).mean() / np.concatenate(of).mean()), float(np.concatenate(rough).max())


def reseen(joint: Joint, blocks: Sequence[Block], clean: Observations, operator) -> float:
    """Error of re-synthesis."""
    square, mean, count = 0.0, 0.0, 0
    for true in blocks_of_observations(clean, Noise(), held_out=0.0):
        index = [block.name for block in blocks].index(true.name)
        scale = blocks[index].unit / true.unit
        error = scale * predicted_radiance(true, joint.solution.lights[index], joint.solution.materials, operator) - true.radiance
        square, mean, count = square + (error**2).sum(), mean + np.abs(true.radiance).sum(), count + error.size
    return float(np.sqrt(square / count) / (mean / count))
