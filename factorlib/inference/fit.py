"""Materials and lights fitted together, by marginal likelihood, and how much each light's observations and prior count.

If residuals were independent, the sum of them over a cluster of n would have a variance of n σ².  It is larger, for residuals are alike (the
design effect of L. Kish, Survey Sampling, 1965), and larger than the noise model says.  The factor is the temperature T, by which squared
residuals are divided:

    T = Σ_k (Σ_{i in k} r_i)² / Σ_k n_k, at least `least`     k: clusters of nearby mirror directions;  r: in σ, clipped at 3   (1)

`least` is 1 while materials are fitted: cells are always a little too coarse, and were T below 1, materials would absorb that error.  Given the materials, lights may be as exact as the residuals are.

Every light has its own, so that a photo whose mesh fits badly counts less; it is estimated anew before each descent.  So are the factors by
which the light's contrast and colour differ from those of a typical light (equation (4) of `factorlib.light.prior`).

Materials are fitted to the observations whose normals are sure (`sure_ones`), for a highlight at a wrong normal says that the material is
rougher than it is, however little it weighs.  Lights are fitted once more to all observations, given those materials: rims and thin parts
show directions that nothing else shows.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.inference.arrow import System
from factorlib.inference.blocks import Block
from factorlib.inference.forward import Illumination
from factorlib.inference.lights import Light
from factorlib.inference.likelihood import LightLikelihood, inverse_of
from factorlib.inference.materials import Materials, Point
from factorlib.inference.noise import Loss
from factorlib.inference.optimizer import Descent, Report
from factorlib.inference.priors import MaterialPrior, materials_of, unknowns_of
from factorlib.inference.problem import JointProblem
from factorlib.inference.responses import Tables
from factorlib.light.prior import LightPrior

SURE = 0.6  # times the typical confidence of a material's normals: what is less sure is left out
DARK = 0.2  # of the noise model's absolute part is left where normals are sure
ROBUST = Loss(3.0)  # beyond 3 σ of the noise model a residual is an outlier
START_TEMPERATURE = 10.0
SUNS = 1.0  # standard deviation of a sun's log radiance: outdoors, captured lights send a third to twice as much by it as by the sky
# Of reflectances: by its logarithm the derivative of a smaller one is nearly zero, and no step would move it.
LEAST_AT_START = 0.01


class Hyperparameters(msgspec.Struct, frozen=True):
    """How much one light's observations and prior count.

    temperature   T of (1), by which squared residuals are divided
    factors       s_k² of the prior: contrast of luminance and of colour beside those of a typical light
    """

    temperature: float = START_TEMPERATURE
    factors: list[float] = msgspec.field(default_factory=lambda: [1.0, 1.0, 1.0])


class Fit(msgspec.Struct, frozen=True):
    """A point, how much each light's observations and prior count there, and minus twice the log marginal likelihood."""

    point: Point
    hyperparameters: list[Hyperparameters]
    value: float = float("inf")

    def with_lights(self, lights: list[Light]) -> Fit:
        """Return the start of another fit, in other lights."""
        return msgspec.structs.replace(self, point=Point(self.point.materials, lights))


class Schedule(msgspec.Struct, frozen=True):
    """How many steps a fit takes.

    lights     of the lights alone, materials given, before all else
    together   of lights and, unless they are given, materials; hyperparameters are estimated anew before each of these descents but the first
    estimate   whether they are estimated before the first one too: right after a splitting, residuals show the splitting, not the noise
    least      the least temperature of (1)
    given      whether materials stay as they are
    """

    lights: int = 0
    together: tuple[int, ...] = ()
    estimate: bool = True
    least: float = 1.0
    given: bool = False

    @property
    def points(self) -> int:
        """The largest number of points that a fit tries."""
        return self.lights + 1 + sum(iterations + 1 for iterations in self.together)


def fitted(
    problem: JointProblem,
    start: Fit,
    prior: LightPrior,
    schedule: Schedule,
    report: Report = lambda loss: None,
) -> Fit:
    """The fit of the observations that are not held out.

    start: where the descent begins; its cells stay;  report: called at every point that is tried, with the mean robust loss of what is fitted
    """
    problem = problem.fitted()
    given = schedule.given
    hyperparameters = start.hyperparameters
    materials = start.point.materials if given else problem.known.put(above_zero(start.point.materials))
    prior_on_materials = MaterialPrior(materials, problem.blocks, problem.known)
    descent = Descent(prior_on_materials, problem.spread, report, problem.known.free(len(materials)))
    illuminations = problem.illuminations(Point(materials, start.point.lights))
    pairs = list(zip(illuminations, hyperparameters, strict=True))

    def likelihood(pair: tuple[Illumination, Hyperparameters]) -> LightLikelihood:
        """Return the likelihood of one light, with a table."""
        return likelihood_of(*pair, prior, given, problem.tables)

    likelihoods = list(problem.spread(likelihood, pairs))
    state = descent.of_lights(likelihoods, unknowns_of(materials), schedule.lights)
    for number, iterations in enumerate(schedule.together):
        if number or schedule.estimate:
            systems = list(zip(state.likelihoods, state.systems, strict=True))
            hyperparameters = list(problem.spread(lambda each: estimated(each[0], each[1], schedule.least), systems))
            both = zip(state.likelihoods, hyperparameters, strict=True)
            state = state._replace(likelihoods=[recounted(*each) for each in both])
        if given:
            state = descent.of_lights(state.likelihoods, state.theta, iterations)
        else:
            state = descent.of_all(state, iterations)
    lights = [one.light for one in state.likelihoods]
    return Fit(Point(materials if given else materials_of(state.theta), lights), hyperparameters, state.value)


def likelihood_of(
    illumination: Illumination,
    one: Hyperparameters,
    prior: LightPrior,
    materials_given: bool = False,
    tables: Tables | None = None,
) -> LightLikelihood:
    """Give an illumination its table of responses, and say how much its observations and the prior count."""
    given = illumination.materials.roughness if materials_given else None
    of = illumination.block, illumination.light.unit_lobes, illumination.operator
    table = (tables or Tables()).of(*of, given)
    tabulated = msgspec.structs.replace(illumination, table=table)
    return recounted(LightLikelihood(tabulated, prior, np.zeros(0), np.zeros((0, 0)), 0.0, 1.0, ROBUST), one)


def recounted(likelihood: LightLikelihood, one: Hyperparameters) -> LightLikelihood:
    """Return the likelihood as other hyperparameters weight it."""
    light = likelihood.light
    Q, log_determinant = likelihood.prior.precision(light.axis[~light.suns], one.factors)
    if light.suns.any():  # of which the prior on cells knows nothing
        own = np.tile(light.suns, 3)
        cells = Q
        Q = np.diag(np.where(own, SUNS**-2.0, 0.0))
        Q[np.ix_(~own, ~own)] = cells
    if light.held.any():  # the precision of the others, given these, is their part of Q
        free = np.tile(light.free, 3)
        log_determinant = float(np.linalg.slogdet(Q[np.ix_(free, free)])[1])
    counts = {"precision": Q, "log_determinant": log_determinant, "temperature": one.temperature}
    return msgspec.structs.replace(likelihood, log_peaks=np.log(light.peaks), **counts)


def estimated(likelihood: LightLikelihood, system: System, least: float) -> Hyperparameters:
    """The hyperparameters by the residuals and the light that a descent ended with; system: there."""
    light = likelihood.light
    cells, free = (np.flatnonzero(np.tile(which, 3)) for which in (~light.suns, light.free))
    covariance = np.zeros((3 * len(light), 3 * len(light)))
    covariance[np.ix_(free, free)] = inverse_of(system.factor[: len(free), : len(free)])
    covariance = covariance[np.ix_(cells, cells)]
    factors = likelihood.prior.likeliest_factors(
        light.axis[~light.suns], light.log_radiance[:, ~light.suns], covariance
    )
    residual = likelihood.illumination.residuals()
    return Hyperparameters(temperature(likelihood.illumination.block, residual, least), factors)


def temperature(block: Block, residual: Float[np.ndarray, "n 3"], least: float = 1.0) -> float:
    """T of (1)."""
    number = block.clusters()
    bounded = residual.clip(-ROBUST.robust_scale, ROBUST.robust_scale)
    sums = [np.bincount(number, channel) for channel in bounded.T]
    return max(float(np.square(sums).sum()) / max(residual.size, 1), least)


def above_zero(materials: Materials) -> Materials:
    """The materials, reflectances raised to at least `LEAST_AT_START`."""
    rows = materials.rows()
    rows[:, :6] = np.maximum(rows[:, :6], LEAST_AT_START)
    return Materials.of_rows(rows)


def sure_ones(problem: JointProblem) -> JointProblem:
    """The observations that materials are fitted to: those whose normals are sure, with less noise in the dark."""
    noises = [msgspec.structs.replace(block.noise, absolute=DARK * block.noise.absolute) for block in problem.blocks]
    return problem.of([b.take(sure(b)).with_noise(noise) for b, noise in zip(problem.blocks, noises, strict=True)])


def sure(block: Block) -> Bool[np.ndarray, " n"]:
    """Whether each normal's confidence is at least `SURE` times the median of its material in this light, by weight."""
    result = np.ones(len(block), bool)
    if block.confidence is None:
        return result
    weight = np.square(block.precision * block.noise.sigma(block.radiance)).max(1)
    for m in np.unique(block.material):
        rows = block.material == m
        typical = np.quantile(block.confidence[rows], 0.5, weights=weight[rows], method="inverted_cdf")
        result[rows] = block.confidence[rows] >= SURE * typical
    return result


def start_of(point: Point) -> Fit:
    """Return the fit that a point is before any descent."""
    return Fit(point, [Hyperparameters() for _ in point.lights])
