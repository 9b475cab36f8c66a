"""The joint solve with a prior on lights: each light is log radiance on a lattice, a Gaussian process with natural light's statistics.

Where geometry and model are exact, lobes found by insertion (`factorlib.solve.rounds`) show a light better than any lattice can.  In
photographs they break into coloured points, for residuals then are errors of normals and surroundings, and nothing says what light looks
like.  Here the prior says it (`factorlib.light.prior`).  Materials maximise the marginal likelihood, with the lights integrated out
(`factorlib.solve.marginal`).

How much the prior counts against the observations is decided by the observations.  If their residuals were independent, the sum of them
over a cluster of n would have a variance of n σ².  It is larger, for residuals are alike (the design effect of L. Kish, Survey Sampling,
1965) and larger than the noise model says.  The factor is the temperature T, by which squared residuals are divided:

    T = Σ_k (Σ_{i in k} r_i)² / Σ_k n_k, at least 1         k: clusters of nearby mirror directions;  r: in σ, clipped at 3   (1)

Every light has its own, so that a photo whose mesh fits badly counts less; it is estimated anew after each descent.  So are the
factors by which the light's contrast and colour differ from those of a typical light (equation (4) of the prior).

Materials are found from the observations whose normals are sure (`sure_ones`), for a highlight at a wrong normal says that the material is
rougher than it is, however little it weighs.  Lights are found once more from all observations, given those materials (`lights_from_all`):
rims and thin parts show directions that nothing else shows.

The factor per channel that is free between materials and lights is held by the sum of the materials' reflectances, which stays as it was
at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from factorlib.light.prior import LightPrior
from factorlib.model.blocks import Block
from factorlib.model.bounds import LEAST_REFLECTANCE, ROUGHNESS
from factorlib.model.cells import clusters_of
from factorlib.model.components import connected_components
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.robust import weighted_median
from factorlib.solve.arrow import damped, masked
from factorlib.solve.cholesky import positive_definite_inverse
from factorlib.solve.lattice import Lattice, Reflections
from factorlib.solve.marginal import Field, Marginal, marginal, shown

LOBES = 400  # of the lattice: 10° apart
OBSERVATIONS = 5000  # of an illumination: materials follow from those in highlights, which are few
SURE = 0.6  # times the typical confidence of a material's normals: what is less sure is left out
DARK = 0.2  # of the noise model's absolute part is left: a lattice leaves out less of the light than a few lobes do
ROBUST_SCALE = 3.0  # σ of the noise model, beyond which a residual is an outlier
LEAST_TEMPERATURE = 1.0
LEAST_AT_START = 0.01  # of reflectances: of a smaller one the derivative by its logarithm is nearly zero, and no step would move it
START_TEMPERATURE = 10.0
SPREADS = np.array([3.0, 3.0, 3.0, 1.0, 1.0, 1.0, 1.0])  # prior standard deviations of log k_d, log k_s, roughness about the start
GAUGE = 0.01  # standard deviation of a channel's summed reflectance about that of the start
MOST_CHANGE = np.array([0.5] * 6 + [0.06])  # of a material's unknowns in one step
MOST_LOG_RADIANCE = 1.5  # change of a cell's log radiance in one step
LIGHT_ITERATIONS, ITERATIONS = 6, (20, 20, 10)  # with the start's materials, then with each estimate of the temperatures
LIGHTS_AGAIN = (10, 10)  # iterations with each estimate of the temperatures, materials given
DAMPING, LOWER, HIGHER, MOST_DAMPING = 1e-3, 0.25, 8.0, 1e3
TOLERANCE = 2e-4  # a descent ends with a step that lowers the value by less than this share of it


class Trust(msgspec.Struct, frozen=True):
    """How much one light's observations and prior count.

    temperature   T of (1), by which squared residuals are divided
    factors       s_k² of the prior: contrast of luminance and of colour beside those of a typical light
    """

    temperature: float = START_TEMPERATURE
    factors: list[float] = msgspec.field(default_factory=lambda: [1.0, 1.0, 1.0])


class Natural(msgspec.Struct, frozen=True):
    """An answer whose lights follow the prior.

    log_radiance   u of each light, in its block's unit;  trusts: how much its observations and its prior count
    value          minus twice the log marginal likelihood, up to a constant
    """

    point: Point
    log_radiance: list[Float[np.ndarray, "3 p"]]
    trusts: list[Trust]
    value: float


class _State(NamedTuple):
    """Unknowns, and the systems there; theta: log k_d, log k_s, roughness."""

    theta: Float[np.ndarray, "m 7"]
    log_radiance: list[Float[np.ndarray, "3 p"]]
    value: float
    parts: list[Marginal]
    prior: Gaussian


class Gaussian(NamedTuple):
    """Minus twice a log density, half its gradient and half its Gauss–Newton Hessian by the materials' unknowns."""

    value: float
    gradient: Float[np.ndarray, " 7m"]
    hessian: Float[np.ndarray, "7m 7m"]


class MaterialPrior:
    """A wide Gaussian about the start, and the gauge: the sum of reflectances of each component and channel."""

    def __init__(self, start: Materials, blocks: Sequence[Block]):
        self.start = unknowns_of(start)
        self.members = [list(members) for members, _ in connected_components(blocks, len(start))]
        self.whole = [_sums(start, members) for members in self.members]

    def at(self, theta: Float[np.ndarray, "m 7"]) -> Gaussian:
        """At the materials' unknowns."""
        off = (theta - self.start) / SPREADS
        value, gradient = float((off**2).sum()), (off / SPREADS).reshape(-1)
        hessian = np.diag(np.tile(SPREADS**-2.0, len(theta)))
        materials = materials_of(theta)
        for members, whole in zip(self.members, self.whole, strict=True):
            for c in range(3):
                slope = np.zeros_like(theta)
                slope[members, c], slope[members, 3 + c] = materials.diffuse[members, c], materials.specular[members, c]
                slope = slope.reshape(-1) / (GAUGE * whole[c])
                residual = (_sums(materials, members)[c] / whole[c] - 1) / GAUGE
                value, gradient, hessian = value + residual**2, gradient + residual * slope, hessian + np.outer(slope, slope)
        return Gaussian(float(value), gradient, hessian)


def naturally(
    problem: JointProblem,
    start: Point,
    prior: LightPrior,
    lambertian: Bool[np.ndarray, " m"],
    report: Callable[[int, float], None] = lambda iteration, loss: None,
    lobes: int = LOBES,
) -> Natural:
    """Materials and lights from the observations that are not held out, with a prior on lights.

    start: its materials are where the descent begins, its exposures and tone curves stay;  lambertian: materials without specular part;
    report: called with the number of each iteration and the mean robust loss of what is fitted;  lobes: of the lattice
    """
    lattice = Lattice.of(lobes)
    fields = fields_of(problem, start, prior, lattice, [Trust()] * len(problem.blocks))
    materials = above_zero(start.materials, lambertian)
    theta, free = unknowns_of(materials), np.ones((len(materials), 7), bool)
    free[lambertian, 3:] = False
    descent = Descent(problem, MaterialPrior(materials, problem.blocks), report)
    lights = [constant(block, materials, lattice) for block in problem.blocks]
    state = descent.run(fields, theta, lights, np.zeros_like(free), LIGHT_ITERATIONS)
    for iterations in ITERATIONS:
        materials = materials_of(state.theta)
        trusts = [trust_in(*one, materials, prior) for one in zip(fields, state.parts, state.log_radiance, strict=True)]
        fields = trusted(fields, trusts, prior)
        state = descent.run(fields, state.theta, state.log_radiance, free, iterations)
    found = materials_of(state.theta)
    found = Materials(found.diffuse, np.where(lambertian[:, None], 0.0, found.specular), found.roughness)
    lights = [lattice.light(u, light) for u, light in zip(state.log_radiance, start.lights, strict=True)]
    return Natural(Point(found, lights), state.log_radiance, trusts, state.value)


def lights_from_all(
    problem: JointProblem, found: Natural, prior: LightPrior, report: Callable[[int, float], None] = lambda iteration, loss: None
) -> Natural:
    """The lights that all observations of `problem` show, given the materials of an answer that was found from some of them; report: as above."""
    lattice, materials = Lattice.of(found.log_radiance[0].shape[1]), found.point.materials
    positive = above_zero(materials, (materials.specular == 0).all(1))
    descent, fixed = Descent(problem, MaterialPrior(positive, problem.blocks), report), np.zeros((len(materials), 7), bool)
    fields, lights, trusts = fields_of(problem, found.point, prior, lattice, found.trusts), found.log_radiance, found.trusts
    for iterations in LIGHTS_AGAIN:
        state = descent.run(fields, unknowns_of(positive), lights, fixed, iterations)
        lights = state.log_radiance
        trusts = [trust_in(*one, positive, prior) for one in zip(fields, state.parts, lights, strict=True)]
        fields = trusted(fields, trusts, prior)
    shown_as = [lattice.light(u, light) for u, light in zip(lights, found.point.lights, strict=True)]
    return Natural(Point(materials, shown_as), lights, trusts, state.value)


def trusted(fields: Sequence[Field], trusts: Sequence[Trust], prior: LightPrior) -> list[Field]:
    """The fields with other temperatures and factors of the prior."""
    return [
        msgspec.structs.replace(field, temperature=one.temperature, precision=prior.precision(field.lattice.axis, one.factors))
        for field, one in zip(fields, trusts, strict=True)
    ]


def sure_ones(problem: JointProblem) -> JointProblem:
    """The observations that materials are found from: those whose normals are sure, with less noise in the dark."""
    blocks = [block.take(sure(block)) for block in problem.blocks]
    blocks = [block.with_noise(msgspec.structs.replace(block.noise, absolute=DARK * block.noise.absolute)) for block in blocks]
    return msgspec.structs.replace(problem, blocks=blocks)


def sure(block: Block) -> Bool[np.ndarray, " n"]:
    """Whether the normal is at least `SURE` times as sure as the typical one of its material, which is the median by weight."""
    result = np.ones(len(block), bool)
    if block.confidence is None:
        return result
    weight = np.square(block.precision * block.noise.sigma(block.radiance)).max(1)
    for m in np.unique(block.material):
        rows = block.material == m
        result[rows] = block.confidence[rows] >= SURE * weighted_median(block.confidence[rows], weight[rows])
    return result


def fields_of(problem: JointProblem, point: Point, prior: LightPrior, lattice: Lattice, trusts: Sequence[Trust]) -> list[Field]:
    """One field an illumination: its observations, lattice, prior and temperature; exposures and tone curves are the point's."""
    return [
        Field(
            block,
            light,
            lattice,
            Reflections(block, lattice, problem.operator),
            prior.precision(lattice.axis, one.factors),
            one.temperature,
            ROBUST_SCALE,
        )
        for block, light, one in zip(problem.blocks, point.lights, trusts, strict=True)
    ]


def above_zero(materials: Materials, lambertian: Bool[np.ndarray, " m"]) -> Materials:
    """The materials, their reflectances raised to at least `LEAST_AT_START`, except the specular ones of Lambertian materials."""
    specular = np.where(lambertian[:, None], materials.specular, np.maximum(materials.specular, LEAST_AT_START))
    return Materials(np.maximum(materials.diffuse, LEAST_AT_START), specular, materials.roughness)


def unknowns_of(materials: Materials) -> Float[np.ndarray, "m 7"]:
    """log k_d, log k_s and roughness."""
    reflectance = np.maximum(np.column_stack([materials.diffuse, materials.specular]), LEAST_REFLECTANCE)
    return np.column_stack([np.log(reflectance), np.clip(materials.roughness, *ROUGHNESS)])


def materials_of(theta: Float[np.ndarray, "m 7"]) -> Materials:
    """The inverse of `unknowns_of`."""
    return Materials(np.exp(theta[:, :3]), np.exp(theta[:, 3:6]), theta[:, 6])


def constant(block: Block, materials: Materials, lattice: Lattice) -> Float[np.ndarray, "3 p"]:
    """The constant light that explains a block's mean radiance."""
    reflectance = (materials.diffuse + materials.specular)[block.material].mean(0)
    level = np.log(np.maximum(block.radiance.mean(0), 1e-6) / np.maximum(reflectance, LEAST_REFLECTANCE))
    return np.repeat(level[:, None], len(lattice), axis=1)


def trust_in(field: Field, part: Marginal, log_radiance: Float[np.ndarray, "3 p"], materials: Materials, prior: LightPrior) -> Trust:
    """By the residuals and the light that a descent ended with; part: its system there."""
    covariance = positive_definite_inverse(part.light_hessian).matrix
    factors = prior.likeliest_factors(field.lattice.axis, log_radiance, covariance)
    return Trust(temperature(field, shown(field, log_radiance, materials).residual), factors)


def temperature(field: Field, residual: Float[np.ndarray, "n 3"]) -> float:
    """T of (1), from residuals no larger than the robust scale."""
    number, bounded = clusters_of(field.block), residual.clip(-field.robust_scale, field.robust_scale)
    sums = [np.bincount(number, channel) for channel in bounded.T]
    return max(float(np.square(sums).sum()) / max(residual.size, 1), LEAST_TEMPERATURE)


class Descent:
    """Levenberg–Marquardt on materials and lights."""

    def __init__(self, problem: JointProblem, material_prior: MaterialPrior, report: Callable[[int, float], None]):
        self.spread, self.material_prior, self.report = problem.spread, material_prior, report
        self.values, self.iteration = max(problem.fitted_values, 1), 0

    def run(
        self,
        fields: Sequence[Field],
        theta: Float[np.ndarray, "m 7"],
        lights: list[Float[np.ndarray, "3 p"]],
        free: Bool[np.ndarray, "m 7"],
        iterations: int,
    ) -> _State:
        """The state after at most so many steps; only the materials' unknowns that are `free` change."""
        state, damping = self._at(fields, theta, lights), DAMPING
        for _ in range(iterations):
            trial = self._at(fields, *_step(state, free, damping))
            if trial.value < state.value:
                small = state.value - trial.value < TOLERANCE * abs(state.value)
                state, damping = trial, damping * LOWER
                if small:
                    break
            elif damping > MOST_DAMPING:
                break
            else:
                damping = max(damping * HIGHER, DAMPING)
        return state

    def _at(self, fields: Sequence[Field], theta: Float[np.ndarray, "m 7"], lights: list[Float[np.ndarray, "3 p"]]) -> _State:
        materials = materials_of(theta)
        parts = list(self.spread(lambda one: marginal(*one, materials), list(zip(fields, lights, strict=True))))
        prior = self.material_prior.at(theta)
        self.report(self.iteration, sum(part.loss for part in parts) / self.values)
        self.iteration += 1
        return _State(theta, lights, sum(part.value for part in parts) + prior.value, parts, prior)


def _step(state: _State, free: Bool[np.ndarray, "m 7"], damping: float) -> tuple[Float[np.ndarray, "m 7"], list[Float[np.ndarray, "3 p"]]]:
    """The unknowns after a damped step: lights eliminated, materials within bounds, lights given the materials' step."""
    hessian = state.prior.hessian + np.sum([part.material_hessian for part in state.parts], axis=0)
    gradient = state.prior.gradient + np.sum([part.material_gradient for part in state.parts], axis=0)
    reduced, solutions = damped(hessian, damping), []
    for part in state.parts:
        factor = cho_factor(damped(part.light_hessian, damping), check_finite=False)
        solution = cho_solve(factor, np.column_stack([part.cross_hessian.T, part.light_gradient]), check_finite=False)
        reduced -= part.cross_hessian @ solution[:, :-1]
        gradient = gradient - part.cross_hessian @ solution[:, -1]
        solutions.append(solution)
    change = np.linalg.solve(masked(reduced, free.reshape(-1)), np.where(free.reshape(-1), -gradient, 0.0)).reshape(-1, 7)
    theta = state.theta + change.clip(-MOST_CHANGE, MOST_CHANGE)
    theta[:, 6] = theta[:, 6].clip(*ROUGHNESS)
    theta[:, :6] = np.maximum(theta[:, :6], np.log(LEAST_REFLECTANCE))
    moved = (theta - state.theta).reshape(-1)
    steps = [-(solution[:, -1] + solution[:, :-1] @ moved) for solution in solutions]
    return theta, [
        u + step.clip(-MOST_LOG_RADIANCE, MOST_LOG_RADIANCE).reshape(u.shape) for u, step in zip(state.log_radiance, steps, strict=True)
    ]


def _sums(materials: Materials, members: Sequence[int]) -> Float[np.ndarray, "3"]:
    return (materials.diffuse + materials.specular)[members].sum(0)
