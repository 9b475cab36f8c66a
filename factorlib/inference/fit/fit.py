"""Joint fit of materials and lights by marginal likelihood, with the weights of each light's observations and prior.

For independent residuals, the sum of n of them in a cluster has the variance n σ².  The actual variance is larger,
because residuals are correlated (design effect, L. Kish, Survey Sampling, 1965) and exceed the noise model.  The ratio
is the temperature T, which divides squared residuals:

    T = Σ_k (Σ_{i in k} r_i)² / Σ_k n_k, at least `least`                                                           (1)

The clusters k hold nearby mirror directions; r is in σ and clipped at 3.  `least` is 1 while materials are fitted:
cells are always a little too coarse, and with T below 1 the materials would absorb that error.  Given the materials,
lights may fit as closely as the residuals allow.

Every light has its own T, so that a photo with a badly fitting mesh counts less.  T is estimated anew before each
descent.  So are the factors that scale the light's contrast and colour relative to a typical light (equation (4) of
`factorlib.light.prior`).

Materials are fitted to the observations with reliable normals (`reliable_observations`).  A highlight at a wrong normal
makes the material look rougher than it is, however little it weighs.  Given those materials, lights are fitted once
more to all observations: rims and thin parts show directions that nothing else shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.inference.fit.exposures import balance_exposures
from factorlib.inference.fit.likelihood import LightLikelihood, System, cholesky_inverse
from factorlib.inference.fit.optimizer import Descent, LossReport
from factorlib.inference.model.background import condition_on_background
from factorlib.inference.model.blocks import FIT_LOSS, Block
from factorlib.inference.model.cast_shadows import cast_shadows
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.lights import Light
from factorlib.inference.model.material_prior import MaterialPrior, material_unknowns, materials_from_unknowns
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.model.responses import ResponseCache
from factorlib.light.prior import LightPrior
from factorlib.results.materials import FitStatus

RELIABLE = 0.6  # least confidence of a normal, as a share of its material's median
DARK_NOISE = 0.2  # factor on the noise model's absolute part where normals are reliable
START_TEMPERATURE = 10.0
# Factor on T where materials are given.  A light absorbs what wrong normals and materials do to a whole object, so that
# residuals do not show it.  With the factor log radiance of made lights is nearer to the truth; with more it is not.
LIGHT_TEMPERATURE = 4.0
# The same where the light's background is observed too.
BACKGROUND_TEMPERATURE = 2.0
# Standard deviation of a sun's log radiance: in lights captured outdoors its energy is a third to twice the sky's.
SUN_DEVIATION = 1.0
# Least reflectance at the start.  The derivative with respect to the logarithm of a smaller one is nearly zero.
LEAST_START_REFLECTANCE = 0.01


class Hyperparameters(msgspec.Struct, frozen=True):
    """Weights of one light's observations and prior.

    Attributes:
        temperature: T of (1), which divides squared residuals.
        factors: s_k² of the prior: contrast of luminance and of colour relative to a typical light.
        turn_variance: Variance of the turns η of poses (`factorlib.inference.model.normal_errors`), of all lights
            together.
    """

    temperature: float = START_TEMPERATURE
    factors: list[float] = msgspec.field(default_factory=lambda: [1.0, 1.0, 1.0])
    turn_variance: float = 1.0


class Fit(msgspec.Struct, frozen=True):
    """Materials and lights that were fitted, with the hyperparameters and the value of the objective.

    Attributes:
        point: Materials and lights.
        hyperparameters: Weights of each light's observations and prior.
        value: Objective, (1) of `factorlib.inference.fit.optimizer`.
        light_values: Part of each light in it: minus twice its log marginal likelihood.
        fitted: True if a descent led to the point; False for a first guess.
        status: Status of the last descent: one of materials and lights together, or one of each light.
    """

    point: Point
    hyperparameters: list[Hyperparameters]
    value: float = float("inf")
    light_values: list[float] = []
    fitted: bool = False
    status: list[FitStatus] = []

    def with_lights(self, lights: list[Light]) -> Fit:
        """Return the start of another fit, in other lights."""
        return msgspec.structs.replace(self, point=Point(self.point.materials, lights))


class FitSchedule(msgspec.Struct, frozen=True):
    """Schedule of a fit: its descents, their steps, and when hyperparameters are estimated.

    Attributes:
        light_steps: Steps of the lights alone, materials given, before the others.
        descents: Number of steps of each descent of lights and, unless they are given, materials.  Hyperparameters are
            estimated anew before each descent but the first; a descent of 0 steps estimates them once more.
        estimate_first: True to estimate them before the first descent too; right after a splitting, residuals reflect
            the splitting and not the noise.
        least_temperature: Least temperature of (1).
        temperature_factor: Factor on the temperature of (1).
        materials_fixed: True to keep the materials fixed.
    """

    light_steps: int = 0
    descents: tuple[int, ...] = ()
    estimate_first: bool = True
    least_temperature: float = 1.0
    temperature_factor: float = 1.0
    materials_fixed: bool = False

    @property
    def points(self) -> int:
        """Largest number of points that a fit by this schedule evaluates."""
        return self.light_steps + 1 + sum(iterations + 1 for iterations in self.descents)


def fit_problem(
    problem: JointProblem, start: Fit, prior: LightPrior, schedule: FitSchedule, report: LossReport = lambda loss: None
) -> Fit:
    """Fit materials and lights to the observations that are not held out, and return the fit with its objective.

    Args:
        problem: Observations and model.
        start: Initial point and hyperparameters; the cells of its lights stay.
        prior: Prior on lights.
        schedule: Number of steps.
        report: Called at every point that is evaluated, with the mean robust loss of the fitted observations.
    """
    problem = problem.without_held_out()
    hyperparameters = start.hyperparameters
    materials = start.point.materials
    if not schedule.materials_fixed:
        materials = problem.known.insert_into(raise_reflectances(materials))
    # a first guess descends without ε: classes of one tint, such as fabrics, would hold both parts at one
    material_prior = partial(MaterialPrior, materials, problem.blocks, problem.known)
    descent = Descent(material_prior(one_tint=start.fitted), problem.spread, report, problem.known.free(len(materials)))
    with_table = partial(light_likelihood, prior=prior, materials_given=schedule.materials_fixed, tables=problem.tables)
    pairs = zip(problem.illuminations(Point(materials, start.point.lights)), hyperparameters, strict=True)
    likelihoods = list(problem.spread(lambda pair: with_table(*pair), list(pairs)))
    state, status = descent.descend_lights(likelihoods, material_unknowns(materials), schedule.light_steps)
    estimate = partial(estimate_hyperparameters, least=schedule.least_temperature, factor=schedule.temperature_factor)
    for number, iterations in enumerate(schedule.descents):
        descent = msgspec.structs.replace(descent, prior=material_prior(one_tint=start.fitted or number > 0))
        if number or schedule.estimate_first:
            # T of (1) and s_k² of each light, from the previous descent
            solved = zip(state.likelihoods, state.systems, strict=True)
            hyperparameters = share_turn_variance(
                list(problem.spread(lambda pair: estimate(*pair), list(solved))),
                [len(likelihood.light.turns) for likelihood in state.likelihoods],
            )
            illuminations = [likelihood.illumination for likelihood in state.likelihoods]
            state = state._replace(likelihoods=list(map(with_table, illuminations, hyperparameters)))
        if schedule.materials_fixed:
            state, status = descent.descend_lights(state.likelihoods, state.theta, iterations)
        else:
            state = descent.linearise(state.likelihoods, state.theta)
            state, joint = descent.descend_jointly(balance_exposures(state, descent, problem.known), iterations)
            status = [joint]
            state = balance_exposures(state, descent, problem.known)
    if schedule.materials_fixed:  # values of systems are φ
        light_values = list(map(LightLikelihood.marginal, state.likelihoods, state.systems))
    else:
        materials = materials_from_unknowns(state.theta)
        light_values = [system.value for system in state.systems]
    value = sum(light_values) + state.prior.value
    point = Point(materials, [each.light for each in state.likelihoods])
    return Fit(point, hyperparameters, value, light_values, True, status)


def light_likelihood(
    illumination: Illumination,
    hyperparameters: Hyperparameters,
    prior: LightPrior,
    materials_given: bool = False,
    tables: ResponseCache | None = None,
) -> LightLikelihood:
    """Return the likelihood of one light, with its table of responses and the given hyperparameters.

    Args:
        illumination: Observations, light and materials; its table is used again.
        hyperparameters: Hyperparameters.
        prior: Prior on lights.
        materials_given: True if the materials do not change.
        tables: Cache of response tables; None for a new one.
    """
    light = illumination.light
    block = illumination.block
    roughness = illumination.materials.roughness if materials_given else None
    arguments = light.unit_lobes, illumination.operator
    table = illumination.table or (tables or ResponseCache()).get(block, *arguments, roughness)
    # Q of the cells, under the scale factors s_k²
    Q, log_determinant = prior.precision(light.axis[~light.suns], hyperparameters.factors)
    if light.suns.any():  # the prior on cells does not cover suns: each has an independent Gaussian
        is_sun = np.tile(light.suns, 3)
        cells = Q
        Q = np.diag(np.where(is_sun, SUN_DEVIATION**-2.0, 0.0))
        Q[np.ix_(~is_sun, ~is_sun)] = cells
        log_determinant -= 2 * int(is_sun.sum()) * float(np.log(SUN_DEVIATION))
    if light.fixed.any():  # Q of the free cells given the fixed ones is their block of Q
        free = np.tile(light.free, 3)
        log_determinant = float(np.linalg.slogdet(Q[np.ix_(free, free)])[1])
    mean = np.zeros(len(Q))
    ground = None
    if block.background is not None and not light.fixed.any():
        mean, Q, log_determinant = condition_on_background(Q, block.background, light)
    if block.ground is not None and not light.fixed.any():
        ground = cast_shadows(block.ground, *arguments)
    tabulated = msgspec.structs.replace(illumination, table=table)
    log_determinant -= len(light.turns) * float(np.log(hyperparameters.turn_variance))
    weights = mean, Q, log_determinant, hyperparameters.temperature, hyperparameters.turn_variance
    return LightLikelihood(tabulated, prior, np.log(light.peaks), *weights, FIT_LOSS, ground)


def estimate_hyperparameters(
    likelihood: LightLikelihood, system: System, least: float, factor: float = 1.0
) -> Hyperparameters:
    """Return the hyperparameters estimated from the residuals and the light at the end of a descent.

    Args:
        likelihood: Likelihood at that point.
        system: Normal equations at that point.
        least: Least temperature.
        factor: Factor on the temperature; at most `BACKGROUND_TEMPERATURE` with a background.
    """
    light = likelihood.light
    cells, free = (np.flatnonzero(np.tile(mask, 3)) for mask in (~light.suns, light.free))
    # covariance of u: H⁻¹ of the free cells, 0 of the fixed ones, without suns
    covariance = np.zeros((3 * len(light), 3 * len(light)))
    integrated = cholesky_inverse(system.factor[: light.integrated, : light.integrated])
    covariance[np.ix_(free, free)] = integrated[: len(free), : len(free)]
    covariance = covariance[np.ix_(cells, cells)]
    factors = likelihood.prior.likeliest_factors(
        light.axis[~light.suns], light.log_radiance[:, ~light.suns], covariance
    )
    if likelihood.illumination.block.background is not None:
        factor = min(factor, BACKGROUND_TEMPERATURE)
    residual = likelihood.illumination.residuals()
    temperature = estimate_temperature(likelihood.illumination.block, residual, least)
    # a step of expectation maximisation: the mean of E[η²]
    turns = slice(len(free), light.integrated)
    variance = float(np.mean(light.turns**2 + np.diag(integrated)[turns])) if len(light.turns) else 1.0
    return Hyperparameters(factor * temperature, factors, variance)


def share_turn_variance(hyperparameters: Sequence[Hyperparameters], turns: Sequence[int]) -> list[Hyperparameters]:
    """Return hyperparameters with one variance of turns, the mean over all lights' `turns`: a light has few."""
    variances = [each.turn_variance for each in hyperparameters]
    shared = float(np.average(variances, weights=turns)) if any(turns) else 1.0
    return [msgspec.structs.replace(each, turn_variance=shared) for each in hyperparameters]


def estimate_temperature(block: Block, residual: Float[np.ndarray, "n 3"], least: float = 1.0) -> float:
    """Return the temperature T of (1), by which correlated residuals count less, from whitened residuals."""
    number = block.clusters()
    bounded = residual.clip(-FIT_LOSS.robust_scale, FIT_LOSS.robust_scale)
    sums = [np.bincount(number, channel) for channel in bounded.T]
    return max(float(np.square(sums).sum()) / max(residual.size, 1), least)


def raise_reflectances(materials: Materials) -> Materials:
    """Return the materials with reflectances raised to at least `LEAST_START_REFLECTANCE`."""
    rows = materials.rows()
    rows[:, :6] = np.maximum(rows[:, :6], LEAST_START_REFLECTANCE)
    return Materials.from_rows(rows)


def reliable_observations(problem: JointProblem) -> JointProblem:
    """Return the observations that materials are fitted to: reliable normals, with less noise in the dark."""
    noises = [
        msgspec.structs.replace(block.noise, absolute=DARK_NOISE * block.noise.absolute) for block in problem.blocks
    ]
    return problem.with_blocks(
        [b.take(reliable_mask(b)).with_noise(noise) for b, noise in zip(problem.blocks, noises, strict=True)]
    )


def reliable_mask(block: Block) -> Bool[np.ndarray, " n"]:
    """Return a mask of the normals whose confidence is at least `RELIABLE` times the weighted median of their material.

    The median is taken over the material's observations in this light.
    """
    result = np.ones(len(block), bool)
    if block.confidence is None:
        return result
    weight = np.square(block.inverse_sigma * block.noise.sigma(block.radiance)).max(1)
    for m in np.unique(block.material):
        rows = block.material == m
        typical = np.quantile(block.confidence[rows], 0.5, weights=weight[rows], method="inverted_cdf")
        result[rows] = block.confidence[rows] >= RELIABLE * typical
    return result


def initial_fit(point: Point) -> Fit:
    """Return a point as the start of a fit, with the initial hyperparameters."""
    return Fit(point, [Hyperparameters() for _ in point.lights])
