"""The hard cases of the solver of few lobes: what is observed, what is true, and how far the answer is from it.

Observations of spheres under lights made of a few lobes, rendered by the operator that solves, with 2 % noise, go the way of the stage:
`blocks_of_observations`, `few_lobes`, standard errors, what cannot be determined.  `CASES` are worse in one way each; tests hold them to
`BOUNDS`, and a study measures them with several seeds of noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from factorlib.diagnose.identifiability import poorly_explained, undetermined_by_answer, undetermined_by_observations
from factorlib.diagnose.uncertainty import standard_errors
from factorlib.model.blocks import Block
from factorlib.model.gauge import connected_components
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.reflection.operator import Operator
from factorlib.solve.few_lobes.options import FewLobes, Run
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.history import Solution
from factorlib.urm.observations import Observations
from studies.scenes.problems import sphere_normals

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
        """Those of the solution."""
        return self.solution.point.materials

    def finite(self) -> bool:
        """Whether all numbers of the solution are."""
        lights = [getattr(light, name) for light in self.solution.point.lights for name in light.__struct_fields__]
        return all(np.isfinite(array).all() for array in (self.materials.vector(), *lights))


# ── Materials, lights, observations ──────────────────────────────────────────────────────────────────────────────────


def chosen(rows: Sequence[int]) -> Materials:
    """Some of the five."""
    return Materials(FIVE.diffuse[list(rows)], FIVE.specular[list(rows)], FIVE.roughness[list(rows)])


def light_of(axis: np.ndarray, log_sharpness: np.ndarray, weight: np.ndarray) -> Light:
    """A light of these lobes, their axes of any length."""
    return Light(axis / np.linalg.norm(axis, axis=1, keepdims=True), log_sharpness, weight, np.zeros(1))


def lamps(seed: int, lobes: int = 3) -> Light:
    """A broad lobe and a few lamps."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(lobes, 3)) + FRONT
    log_sharpness = np.concatenate([[np.log(0.5)], np.log(60.0) * rng.uniform(0.5, 1, lobes - 1)])
    energy = rng.lognormal(0, 0.3, (lobes, 1)) * rng.lognormal(0, 0.1, (lobes, 3))
    return light_of(axis, log_sharpness, energy * np.exp(log_sharpness * 0.8)[:, None])


def light(*lobes: tuple[tuple[float, float, float], float, float]) -> Light:
    """A light of grey lobes (axis, sharpness, weight)."""
    axis, sharpness, weight = (np.array(column, dtype=float) for column in zip(*lobes, strict=True))
    return light_of(axis, np.log(sharpness), np.repeat(weight[:, None], 3, 1))


ROOMS = [lamps(seed) for seed in range(5)]
POINT = light(((0.3, -0.5, -0.8), 2000.0, 3000.0))
CONSTANT = light(((0.0, 0.0, -1.0), 1e-4, 1.0))
SUNNY = light(((0.0, -1.0, -0.2), 0.1, SKY), ((0.6, -0.5, -0.6), 2000.0, SUN))
FLAT = np.tile(np.array([[0.3, 0.1, -1.0]]) / np.sqrt(1.1), (60, 1))
PATCH = sphere_normals(10)[::2][:30]
SPHERE = sphere_normals(12)


def observed(
    truth: Materials, lights: Sequence[Light], shown: Sequence[Sequence[int]], normals: np.ndarray = SPHERE
) -> Observations:
    """Observations without noise of the normals, seen from the front, in each material that light i shows."""
    parts, n = [(i, m) for i, materials in enumerate(shown) for m in materials], len(normals)
    photo, material = (np.repeat([part[k] for part in parts], n) for k in (0, 1))
    total, names = len(photo), tuple(f"room{i}" for i in range(len(lights)))
    seen = Observations(
        normal=np.tile(normals, (len(parts), 1)), view=np.tile(FRONT, (total, 1)), radiance=np.ones((total, 3)),
        clipped=np.zeros((total, 3), bool), material=material, photo=photo, illumination=photo, x=np.arange(total),
        y=np.zeros(total, int), weight=np.ones(total), materials=NAMES[: len(truth)], photos=names, illuminations=names,
    )  # fmt: skip
    for i, (block, lobes) in enumerate(zip(blocks_of_observations(seen, Noise()), lights, strict=True)):
        seen.radiance[photo == i] = Illumination(block, lobes, truth, OPERATOR).radiance()
    return seen


# ── Cases: functions of a seed of noise ──────────────────────────────────────────────────────────────────────────────


def noisy(seen: Observations, seed: int = 0, share: float = 0.02) -> Observations:
    """With noise of that share of each radiance."""
    random = np.random.default_rng(seed).normal(size=seen.radiance.shape)
    return msgspec.structs.replace(seen, radiance=seen.radiance * (1 + share * random))


def tilted(seen: Observations, degrees: np.ndarray, seed: int) -> Observations:
    """Each normal turned by its own angle toward a random side."""
    side = np.cross(seen.normal, np.random.default_rng(seed).normal(size=seen.normal.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.radians(degrees)[:, None]
    return msgspec.structs.replace(seen, normal=np.cos(angle) * seen.normal + np.sin(angle) * side)


def clipped(seen: Observations, share: float = 0.5) -> Observations:
    """With that share of the values at a limit."""
    limit = np.quantile(seen.radiance, 1 - share)
    return msgspec.structs.replace(seen, radiance=np.minimum(seen.radiance, limit), clipped=seen.radiance >= limit)


def with_wrong_normals(seen: Observations, seed: int) -> Observations:
    """A fifth of the normals turned by 40°."""
    return tilted(seen, 40.0 * (np.random.default_rng(seed).random(len(seen)) < 0.2), seed)


def with_invalid(seen: Observations, seed: int) -> Observations:
    """Some values not finite, and some views without direction."""
    radiance, normal, view = seen.radiance.copy(), seen.normal.copy(), seen.view.copy()
    radiance[::11, 0], radiance[1::11, 1], radiance[2::11, 2] = np.nan, np.inf, -np.inf
    normal[3::11, 0], view[4::11] = np.nan, 0
    return msgspec.structs.replace(seen, radiance=radiance, normal=normal, view=view)


def case(truth: Materials, lights: Sequence[Light], shown=None, normals=SPHERE) -> Callable[[int], Case]:
    """The case of these materials in these lights; shown: by light, the materials that it shows (all)."""

    def of(seed: int) -> Case:
        clean = observed(truth, lights, shown or [range(len(truth))] * len(lights), normals)
        return Case(noisy(clean, seed), clean, truth)

    return of


TWO, THREE = chosen([1, 2]), chosen([0, 1, 2])
ORDINARY = case(TWO, ROOMS[:2])
LAMBERTIAN = Materials(TWO.diffuse, TWO.specular * 0, TWO.roughness)
MIRRORS = Materials(TWO.diffuse * 0.05, TWO.specular + 0.3, np.full(2, 0.1))
WITH_BLACK = Materials(THREE.diffuse * [[0], [1], [1]], THREE.specular * [[0], [1], [1]], THREE.roughness)


def perturbed(perturbation: Callable[[Observations, int], Observations]) -> Callable[[int], Case]:
    """The ordinary case after `perturbation(seen, seed)`."""

    def of(seed: int) -> Case:
        ordinary = ORDINARY(seed)
        return msgspec.structs.replace(ordinary, seen=perturbation(ordinary.seen, seed))

    return of


def with_noise_on_normals(degrees: float) -> Callable[[int], Case]:
    """Each normal turned by an angle of half-normal distribution with that deviation."""
    return perturbed(
        lambda seen, seed: tilted(seen, degrees * np.abs(np.random.default_rng(seed).normal(size=len(seen))), seed + 1)
    )


def of_brightness(factor: float) -> Callable[[int], Case]:
    """The ordinary case with all radiances times a factor."""

    def of(seed: int) -> Case:
        one = ORDINARY(seed)
        scaled = (msgspec.structs.replace(o, radiance=o.radiance * factor) for o in (one.seen, one.clean))
        return Case(*scaled, TWO)

    return of


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
    "half the values clipped": perturbed(lambda seen, seed: clipped(seen)),
    "all values clipped": perturbed(lambda seen, seed: clipped(seen, 1.0)),
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

    None: cannot be determined, and is said.  may_say: what is neither asked for nor wrong
    """

    k: float | None
    roughness: float | None
    radiance: float
    says: tuple[str, ...] = ()
    may_say: str | None = None


RED, GREEN = (f"roughness of material '{name}' cannot be determined" for name in NAMES[:2])
BOUNDS = {
    "ordinary: 2 materials × 2 lights": Bound(0.0043, 0.022, 0.0048),
    "1 material × 1 light": Bound(0.025, 0.02, 0.0065, ("by convention only, and a smooth material in a soft light",)),
    "1 material × 5 lights": Bound(0.013, 0.019, 0.0063, ("by convention only. A photo",)),
    "5 materials × 1 light": Bound(0.0082, 0.0097, 0.0035),
    "unconnected: 2 × 1 and 3 × 1": Bound(0.0093, 0.025, 0.0045),
    "flat objects": Bound(None, None, 0.0025, ("'red' is flat", "'green' is flat", RED)),
    "an object of 30 pixels": Bound(None, None, 0.037, ("30 observation(s)", "by convention only")),
    "a single pixel": Bound(None, None, 0.0074, ("1 observation(s)", "'red' is flat")),
    "all Lambertian": Bound(0.0049, None, 0.0097, (RED, GREEN)),
    "all mirror-like: roughness .1": Bound(0.0044, 0.017, 0.0052, (), "the least the model knows: it may be smoother"),
    "a black material": Bound(0.0055, 0.0068, 0.0049, ("'red' is so dark", RED)),
    "a light of one point": Bound(0.017, 0.0039, 0.0042),
    "constant light": Bound(None, None, 0.0043, (RED, GREEN)),
    "radiances × 10⁻⁴": Bound(0.0044, 0.022, 0.0048),
    "radiances × 10⁴": Bound(0.0044, 0.022, 0.0048),
    "sun 10⁴ × the sky": Bound(0.0077, 0.012, 0.0049),
    "half the values clipped": Bound(0.042, 0.19, 0.1, ("of the values of material 'red' are clipped",)),
    "all values clipped": Bound(
        None, None, 0.45, tuple(f"100% of the values of material '{name}'" for name in NAMES[:2])
    ),
    "20 % of normals wrong by 40°": Bound(None, 0.25, 0.2, ("of the values differ from the answer",)),
    "normals with noise of 1°": Bound(0.025, 0.059, 0.022),
    "normals with noise of 2°": Bound(0.1, 0.17, 0.053, (), "roughness of material"),
    "normals with noise of 5°": Bound(0.043, 0.19, 0.18, (), "roughness of material"),
    "normals with noise of 10°": Bound(0.13, 0.15, 0.13, ("of the values differ from the answer",)),
    "two equal materials": Bound(0.019, 0.024, 0.0048),
    "a material without pixels": Bound(0.0077, 0.017, 0.0048),
    "NaN, infinite, no direction": Bound(0.012, 0.015, 0.0094),
}

# ── Answers ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def answered(given: Case, options: FewLobes = QUICK, operator: Operator = OPERATOR) -> Answer:
    """The answer, compared with the clean observations."""
    blocks, names = blocks_of_observations(given.seen, Noise(), seed=options.seed), given.seen.materials
    problem, said = JointProblem(blocks, operator), undetermined_by_observations(names, blocks)
    solution = few_lobes(problem, len(given.truth), Run(options))
    point, materials = solution.point, solution.point.materials
    errors = standard_errors(problem.with_loss(solution.loss), point)
    said += undetermined_by_answer(names, problem.blocks, materials, errors.materials)
    said += poorly_explained(problem, point)
    k, roughness = _material_errors(materials, given.truth, problem.blocks)
    return Answer(k, roughness, _radiance_error(problem, solution, given.clean), said, solution)


def of_random_starts(given: Case, count: int = 10) -> list[Answer]:
    """The answers from as many starting materials, held-out cells and samples."""
    random = np.random.default_rng(0)
    starts = [(random.uniform(0.15, 0.9), random.uniform(0.05, 0.6)) for _ in range(count)]
    names = ("start_roughness", "start_specular_share", "seed")
    options = [dict(zip(names, (*start, seed), strict=True)) for seed, start in enumerate(starts)]
    return [answered(given, msgspec.structs.replace(QUICK, **option)) for option in options]


def _material_errors(found: Materials, truth: Materials, blocks: Sequence[Block]) -> tuple[float, float]:
    """Errors of reflectance and roughness, of the materials that were seen."""
    errors, whole, rough = [], [], [0.0]
    for members, lights in connected_components(blocks, len(truth)):
        if not lights:
            continue
        rows = list(members)
        f, t = (np.stack([m.diffuse[rows], m.specular[rows]]) for m in (found, truth))
        errors.append(np.abs(f * t.sum((0, 1)) / f.sum((0, 1)) - t).ravel())
        whole.append(t.sum(0).ravel())
        rough += [abs(found.roughness[m] - truth.roughness[m]) for m in rows if truth.specular[m].max() > GLOSSY]
    return float(np.concatenate(errors).mean() / np.concatenate(whole).mean()), float(max(rough))


def _radiance_error(problem: JointProblem, solution: Solution, clean: Observations) -> float:
    names, relative, point = [block.name for block in problem.blocks], [], solution.point
    for true in blocks_of_observations(clean, Noise()):
        i = names.index(true.name)
        radiance = Illumination(true, point.lights[i], point.materials, problem.operator).radiance()
        relative.append((radiance * problem.blocks[i].unit / true.unit - true.radiance) / (true.radiance + 1))
    return float(np.sqrt(np.mean(np.concatenate(relative) ** 2)))
