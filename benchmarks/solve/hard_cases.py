"""The hard cases of the joint solve: what is seen, what is true, and how far the answer is from it.

Observations of spheres under lights made of a few lobes, rendered by the operator that solves, with 2 % noise, go the way of
the stage: `blocks_of_observations`, `few_lobes`, standard errors, what cannot be determined.  `CASES` are worse in one way each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from benchmarks.solve.problems import sphere_normals
from factorlib.diagnose.identifiability import poorly_explained, undetermined_by_answer, undetermined_by_observations
from factorlib.diagnose.uncertainty import standard_errors
from factorlib.model.blocks import Block
from factorlib.model.components import connected_components
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
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.history import Solution
from factorlib.urm.observations import Observations

OPERATOR = reflection_operator("network")
QUICK = FewLobes(lobes=10, insert=5, rounds=4, iterations=10, polish=20, tolerance=1e-3)
FIVE = Materials(
    diffuse=np.array([[0.5, 0.1, 0.1], [0.2, 0.4, 0.25], [0.1, 0.12, 0.2], [0.3, 0.3, 0.05], [0.25, 0.2, 0.3]]),
    specular=np.array([[0.12, 0.12, 0.12], [0.2, 0.2, 0.2], [0.4, 0.35, 0.3], [0.1, 0.1, 0.1], [0.3, 0.3, 0.3]]),
    roughness=np.array([0.7, 0.4, 0.25, 0.5, 0.3]),
)
NAMES = ("red", "green", "blue", "yellow", "violet")
FRONT = np.array([0.0, 0.0, -1.0])
GLOSSY = 0.02  # specular reflectance below which a true roughness shows in nothing
SKY, SUN = 1.0, 1e4  # radiances


class Case(msgspec.Struct, frozen=True):
    """What is `seen`, what would be without noise and perturbation (`clean`), and the materials it was made with."""

    seen: Observations
    clean: Observations
    truth: Materials


class Answer(msgspec.Struct, frozen=True):
    """What came out of a case, and what was said with it.

    k:         mean error of diffuse and specular reflectance over the mean of their sum, after one factor per channel and component
    roughness: largest error, of materials that have a highlight
    radiance:  RMS error of re-synthesis of the clean observations, each over its radiance plus their mean
    """

    k: float
    roughness: float
    radiance: float
    said: list[str]
    solution: Solution

    @property
    def materials(self) -> Materials:
        return self.solution.point.materials


def chosen(rows: Sequence[int]) -> Materials:
    return Materials(FIVE.diffuse[list(rows)], FIVE.specular[list(rows)], FIVE.roughness[list(rows)])


TWO, THREE = chosen([1, 2]), chosen([0, 1, 2])


def lamps(seed: int, lobes: int = 3) -> Light:
    """A broad lobe and a few lamps."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(lobes, 3)) + FRONT
    log_sharpness = np.concatenate([[np.log(0.5)], np.log(60.0) * rng.uniform(0.5, 1, lobes - 1)])
    weight = (
        rng.lognormal(0, 0.3, (lobes, 1)) * rng.lognormal(0, 0.1, (lobes, 3)) * np.exp(log_sharpness * 0.8)[:, None]
    )
    return Light(axis / np.linalg.norm(axis, axis=1, keepdims=True), log_sharpness, weight, np.zeros(1))


def light(*lobes: tuple[tuple[float, float, float], float, float]) -> Light:
    """Of grey lobes (axis, sharpness, weight)."""
    axis, sharpness, weight = (np.array(column, dtype=float) for column in zip(*lobes, strict=True))
    return Light(
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        np.log(sharpness),
        np.repeat(weight[:, None], 3, 1),
        np.zeros(1),
    )


ROOMS = [lamps(seed) for seed in range(5)]
POINT = light(((0.3, -0.5, -0.8), 2000.0, 3000.0))
CONSTANT = light(((0.0, 0.0, -1.0), 1e-4, 1.0))
SUNNY = light(((0.0, -1.0, -0.2), 0.1, SKY), ((0.6, -0.5, -0.6), 2000.0, SUN))
FLAT = np.tile(np.array([[0.3, 0.1, -1.0]]) / np.sqrt(1.1), (60, 1))


def observed(truth: Materials, lights: Sequence[Light], shown: Sequence[Sequence[int]], normals=None) -> Observations:
    """A sphere, or any `normals`, of each material that photo i shows, in light i, without noise."""
    normals = sphere_normals(12) if normals is None else normals
    parts = [(i, m) for i, materials in enumerate(shown) for m in materials]
    n, count, names = len(normals), len(parts), tuple(f"room{i}" for i in range(len(lights)))
    photo = np.repeat([i for i, _ in parts], n)
    seen = Observations(
        normal=np.tile(normals, (count, 1)), view=np.tile(FRONT, (n * count, 1)), radiance=np.ones((n * count, 3)),
        clipped=np.zeros((n * count, 3), bool), material=np.repeat([m for _, m in parts], n), photo=photo, illumination=photo,
        x=np.arange(n * count), y=np.zeros(n * count, int), weight=np.ones(n * count),
        materials=NAMES[: len(truth)], photos=names, illuminations=names,
    )  # fmt: skip
    radiance = seen.radiance.copy()
    for block, lobes in zip(
        blocks_of_observations(seen, Noise()), lights, strict=True
    ):  # their rows are those of `parts`
        radiance[photo == names.index(block.name)] = Illumination(block, lobes, truth, OPERATOR).radiance()
    return msgspec.structs.replace(seen, radiance=radiance)


def noisy(seen: Observations, seed: int = 0, share: float = 0.02) -> Observations:
    random = np.random.default_rng(seed).normal(size=seen.radiance.shape)
    return msgspec.structs.replace(seen, radiance=seen.radiance * (1 + share * random))


def tilted(seen: Observations, degrees: np.ndarray, seed: int) -> Observations:
    """Each normal turned by its own angle toward a random side."""
    side = np.cross(seen.normal, np.random.default_rng(seed).normal(size=seen.normal.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.radians(degrees)[:, None]
    return msgspec.structs.replace(seen, normal=np.cos(angle) * seen.normal + np.sin(angle) * side)


def case(truth: Materials, lights: Sequence[Light], shown=None, normals=None) -> Callable[[int], Case]:
    def of(seed: int) -> Case:
        clean = observed(truth, lights, [range(len(truth))] * len(lights) if shown is None else shown, normals)
        return Case(noisy(clean, seed), clean, truth)

    return of


ORDINARY = case(TWO, ROOMS[:2])


def perturbed(perturbation: Callable[[Observations, int], Observations]) -> Callable[[int], Case]:
    """The ordinary case after `perturbation(seen, seed)`."""

    def of(seed: int) -> Case:
        ordinary = ORDINARY(seed)
        return msgspec.structs.replace(ordinary, seen=perturbation(ordinary.seen, seed))

    return of


def of_brightness(factor: float) -> Callable[[int], Case]:
    def of(seed: int) -> Case:
        seen, clean = (
            msgspec.structs.replace(o, radiance=o.radiance * factor)
            for o in (ORDINARY(seed).seen, ORDINARY(seed).clean)
        )
        return Case(seen, clean, TWO)

    return of


def clipped(seen: Observations, seed: int, share: float = 0.5) -> Observations:
    limit = np.quantile(seen.radiance, 1 - share)
    return msgspec.structs.replace(seen, radiance=np.minimum(seen.radiance, limit), clipped=seen.radiance >= limit)


def with_wrong_normals(seen: Observations, seed: int) -> Observations:
    wrong = np.random.default_rng(seed).random(len(seen)) < 0.2
    return tilted(seen, 40.0 * wrong, seed)


def with_noise_on_normals(degrees: float) -> Callable[[int], Case]:
    return perturbed(
        lambda seen, seed: tilted(seen, degrees * np.abs(np.random.default_rng(seed).normal(size=len(seen))), seed + 1)
    )


def with_invalid(seen: Observations, seed: int) -> Observations:
    radiance, normal, view = seen.radiance.copy(), seen.normal.copy(), seen.view.copy()
    radiance[::11, 0], radiance[1::11, 1], radiance[2::11, 2], normal[3::11, 0], view[4::11] = (
        np.nan,
        np.inf,
        -np.inf,
        np.nan,
        0,
    )
    return msgspec.structs.replace(seen, radiance=radiance, normal=normal, view=view)


LAMBERTIAN = Materials(TWO.diffuse, TWO.specular * 0, TWO.roughness)
MIRRORS = Materials(TWO.diffuse * 0.05, TWO.specular + 0.3, np.full(2, 0.1))
WITH_BLACK = Materials(THREE.diffuse * [[0], [1], [1]], THREE.specular * [[0], [1], [1]], THREE.roughness)
PATCH = sphere_normals(10)[::2][:30]

CASES: dict[str, Callable[[int], Case]] = {
    "ordinary: 2 materials × 2 lights": ORDINARY,
    "1 material × 1 light": case(chosen([1]), ROOMS[:1]),
    "1 material × 5 lights": case(chosen([1]), ROOMS),
    "5 materials × 1 light": case(FIVE, ROOMS[:1]),
    "unconnected: 2 × 1 and 3 × 1": case(FIVE, ROOMS[:2], [[0, 1], [2, 3, 4]]),
    "flat objects": case(TWO, ROOMS[:2], normals=FLAT),
    "an object of 30 pixels": case(chosen([1]), ROOMS[:1], normals=PATCH),
    "a single pixel": case(chosen([1]), ROOMS[:1], normals=FLAT[:1]),
    "all Lambertian": case(LAMBERTIAN, ROOMS[:2]),
    "all mirror-like: roughness .1": case(MIRRORS, ROOMS[:2]),
    "a black material": case(WITH_BLACK, ROOMS[:2]),
    "a light of one point": case(TWO, [POINT]),
    "constant light": case(TWO, [CONSTANT, CONSTANT]),
    "radiances × 10⁻⁴": of_brightness(1e-4),
    "radiances × 10⁴": of_brightness(1e4),
    "sun 10⁴ × the sky": case(TWO, [SUNNY, ROOMS[1]]),
    "half the values clipped": perturbed(clipped),
    "all values clipped": perturbed(lambda seen, seed: clipped(seen, seed, 1.0)),
    "20 % of normals wrong by 40°": perturbed(with_wrong_normals),
    "normals with noise of 1°": with_noise_on_normals(1),
    "normals with noise of 2°": with_noise_on_normals(2),
    "normals with noise of 5°": with_noise_on_normals(5),
    "normals with noise of 10°": with_noise_on_normals(10),
    "two equal materials": case(chosen([1, 1]), ROOMS[:2]),
    "a material without pixels": case(THREE, ROOMS[:2], [[1, 2], [1, 2]]),
    "NaN, infinite, no direction": perturbed(with_invalid),
}


class Bound(msgspec.Struct, frozen=True):
    """Largest errors of an `Answer`: a quarter more than the worst of four differently trained weights and two seeds of noise each.
    None: cannot be determined, and is said."""

    k: float | None
    roughness: float | None
    radiance: float
    says: tuple[str, ...] = ()
    may_say: str | None = None  # what is neither asked for nor wrong


BOUNDS = {
    "ordinary: 2 materials × 2 lights": Bound(0.0043, 0.022, 0.0048),
    "1 material × 1 light": Bound(0.025, 0.02, 0.0065, ("by convention only, and a smooth material in a soft light",)),
    "1 material × 5 lights": Bound(0.013, 0.019, 0.0063, ("by convention only. A photo",)),
    "5 materials × 1 light": Bound(0.0082, 0.0097, 0.0035),
    "unconnected: 2 × 1 and 3 × 1": Bound(0.0093, 0.025, 0.0045),
    "flat objects": Bound(
        None, None, 0.0025, ("'red' is flat", "'green' is flat", "roughness of material 'red' cannot be determined")
    ),
    "an object of 30 pixels": Bound(None, None, 0.037, ("30 observation(s)", "by convention only")),
    "a single pixel": Bound(None, None, 0.0074, ("1 observation(s)", "'red' is flat")),
    "all Lambertian": Bound(
        0.0049,
        None,
        0.0097,
        ("roughness of material 'red' cannot be determined", "roughness of material 'green' cannot be determined"),
    ),
    "all mirror-like: roughness .1": Bound(
        0.0044, 0.017, 0.0052, may_say="the least the model knows: it may be smoother"
    ),
    "a black material": Bound(
        0.0055, 0.0068, 0.0049, ("'red' is so dark", "roughness of material 'red' cannot be determined")
    ),
    "a light of one point": Bound(0.017, 0.0039, 0.0042),
    "constant light": Bound(
        None,
        None,
        0.0043,
        ("roughness of material 'red' cannot be determined", "roughness of material 'green' cannot be determined"),
    ),
    "radiances × 10⁻⁴": Bound(0.0044, 0.022, 0.0048),
    "radiances × 10⁴": Bound(0.0044, 0.022, 0.0048),
    "sun 10⁴ × the sky": Bound(0.0077, 0.012, 0.0049),
    "half the values clipped": Bound(0.042, 0.19, 0.1, ("of the values of material 'red' are clipped",)),
    "all values clipped": Bound(
        None, None, 0.45, ("100% of the values of material 'red' are clipped", "100% of the values of material 'green'")
    ),
    "20 % of normals wrong by 40°": Bound(None, 0.25, 0.2, ("of the values differ from the answer",)),
    "normals with noise of 1°": Bound(0.025, 0.059, 0.022),
    "normals with noise of 2°": Bound(0.1, 0.17, 0.053, may_say="roughness of material"),
    "normals with noise of 5°": Bound(0.043, 0.19, 0.18, may_say="roughness of material"),
    "normals with noise of 10°": Bound(0.13, 0.15, 0.13, ("of the values differ from the answer",)),
    "two equal materials": Bound(0.019, 0.024, 0.0048),
    "a material without pixels": Bound(0.0077, 0.017, 0.0048),
    "NaN, infinite, no direction": Bound(0.012, 0.015, 0.0094),
}


def answered(given: Case, options: FewLobes = QUICK, operator: Operator = OPERATOR) -> Answer:
    """The answer, compared with the clean observations."""
    problem, names = (
        JointProblem(blocks_of_observations(given.seen, Noise(), seed=options.seed), operator),
        given.seen.materials,
    )
    said = undetermined_by_observations(names, problem.blocks)
    solution = few_lobes(problem, len(given.truth), Run(options))
    found, materials = solution.point, solution.point.materials
    errors = standard_errors(problem.with_loss(solution.loss), found)
    said += undetermined_by_answer(names, problem.blocks, materials, errors.materials)
    said += poorly_explained(problem, found)
    k, roughness = material_errors(materials, given.truth, problem.blocks)
    return Answer(k, roughness, radiance_error(problem, solution, given.clean), said, solution)


def of_random_starts(given: Case, count: int = 10, options: FewLobes = QUICK) -> list[Answer]:
    """From as many starting materials, held-out cells and samples."""
    random = np.random.default_rng(0)
    starts = [(random.uniform(0.15, 0.9), random.uniform(0.05, 0.6)) for _ in range(count)]
    return [
        answered(
            given, msgspec.structs.replace(options, start_roughness=roughness, start_specular_share=share, seed=seed)
        )
        for seed, (roughness, share) in enumerate(starts)
    ]


def is_finite(answer: Answer) -> bool:
    lights = [getattr(found, name) for found in answer.solution.point.lights for name in found.__struct_fields__]
    return all(np.isfinite(array).all() for array in (answer.materials.vector(), *lights))


def material_errors(found: Materials, truth: Materials, blocks: Sequence[Block]) -> tuple[float, float]:
    """Errors of reflectance and roughness, of the materials that were seen."""
    errors, whole, rough = [], [], [0.0]
    for members, lights in connected_components(blocks, len(truth)):
        if not lights:
            continue
        rows = list(members)
        f, t = (np.stack([m.diffuse[rows], m.specular[rows]]) for m in (found, truth))
        factor = t.sum((0, 1)) / f.sum((0, 1))
        errors.append(np.abs(f * factor - t).ravel())
        whole.append(t.sum(0).ravel())
        rough += [abs(found.roughness[m] - truth.roughness[m]) for m in rows if truth.specular[m].max() > GLOSSY]
    return float(np.concatenate(errors).mean() / np.concatenate(whole).mean()), float(max(rough))


def radiance_error(problem: JointProblem, solution: Solution, clean: Observations) -> float:
    names, relative, point = [block.name for block in problem.blocks], [], solution.point
    for true in blocks_of_observations(clean, Noise()):
        i = names.index(true.name)
        found = (
            Illumination(true, point.lights[i], point.materials, problem.operator).radiance()
            * problem.blocks[i].unit
            / true.unit
        )
        relative.append((found - true.radiance) / (true.radiance + 1))
    return float(np.sqrt(np.mean(np.concatenate(relative) ** 2)))
