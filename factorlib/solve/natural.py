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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.light.prior import LightPrior
from factorlib.model.blocks import Block
from factorlib.model.bounds import LEAST_REFLECTANCE
from factorlib.model.cells import clusters_of
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.cholesky import positive_definite_inverse
from factorlib.solve.lattice import Lattice, Reflections
from factorlib.solve.marginal import Field, Marginal, shown
from factorlib.solve.marginal_descent import MarginalDescent, MaterialPrior, State, materials_of, unknowns_of

LOBES = 400  # of the lattice: 10° apart
OBSERVATIONS = 5000  # of an illumination: materials follow from those in highlights, which are few
SURE = 0.6  # times the typical confidence of a material's normals: what is less sure is left out
DARK = 0.2  # of the noise model's absolute part is left: a lattice leaves out less of the light than a few lobes do
ROBUST_SCALE = 3.0  # σ of the noise model, beyond which a residual is an outlier
LEAST_TEMPERATURE = 1.0
LEAST_AT_START = 0.01  # of reflectances: of a smaller one the derivative by its logarithm is nearly zero, and no step would move it
START_TEMPERATURE = 10.0
LIGHT_ITERATIONS, ITERATIONS = 6, (20, 20, 10)  # with the start's materials, then with each estimate of the temperatures
LIGHTS_AGAIN = (10, 10)  # iterations with each estimate of the temperatures, materials given


class Hyperparameters(msgspec.Struct, frozen=True):
    """How much one light's observations and prior count.

    temperature   T of (1), by which squared residuals are divided
    factors       s_k² of the prior: contrast of luminance and of colour beside those of a typical light
    """

    temperature: float = START_TEMPERATURE
    factors: list[float] = msgspec.field(default_factory=lambda: [1.0, 1.0, 1.0])


class Natural(msgspec.Struct, frozen=True):
    """An answer whose lights follow the prior.

    log_radiance   u of each light, in its block's unit;  hyperparameters: how much its observations and its prior count
    value          minus twice the log marginal likelihood, up to a constant
    """

    point: Point
    log_radiance: list[Float[np.ndarray, "3 p"]]
    hyperparameters: list[Hyperparameters]
    value: float


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
    fields = fields_of(problem, start, prior, lattice, [Hyperparameters()] * len(problem.blocks))
    materials = above_zero(start.materials, lambertian)
    theta, free = unknowns_of(materials), np.ones((len(materials), 7), bool)
    free[lambertian, 3:] = False
    descent = MarginalDescent(problem, MaterialPrior(materials, problem.blocks), report)
    lights = [constant(block, materials, lattice) for block in problem.blocks]
    state = descent.run(fields, theta, lights, np.zeros_like(free), LIGHT_ITERATIONS)
    state, hyperparameters = alternated(descent, fields, state, free, prior, ITERATIONS)
    found = materials_of(state.theta)
    found = Materials(found.diffuse, np.where(lambertian[:, None], 0.0, found.specular), found.roughness)
    lights = [lattice.light(u, light) for u, light in zip(state.log_radiance, start.lights, strict=True)]
    return Natural(Point(found, lights), state.log_radiance, hyperparameters, state.value)


def lights_from_all(
    problem: JointProblem, found: Natural, prior: LightPrior, report: Callable[[int, float], None] = lambda iteration, loss: None
) -> Natural:
    """The lights that all observations of `problem` show, given the materials of an answer that was found from some of them.

    report: as of `naturally`
    """
    lattice, materials = Lattice.of(found.log_radiance[0].shape[1]), found.point.materials
    theta = unknowns_of(materials)
    fixed = np.zeros_like(theta, bool)
    fields = fields_of(problem, found.point, prior, lattice, found.hyperparameters)
    descent = MarginalDescent(problem, MaterialPrior(materials, problem.blocks), report)
    state = descent.run(fields, theta, found.log_radiance, fixed, 0)
    state, hyperparameters = alternated(descent, fields, state, fixed, prior, LIGHTS_AGAIN)
    lights = [lattice.light(u, light) for u, light in zip(state.log_radiance, found.point.lights, strict=True)]
    return Natural(Point(materials, lights), state.log_radiance, hyperparameters, state.value)


def alternated(
    descent: MarginalDescent, fields: list[Field], state: State, free: Bool[np.ndarray, "m 7"], prior: LightPrior, iterations: Sequence[int]
) -> tuple[State, list[Hyperparameters]]:
    """Hyperparameters estimated at the state, then a descent with them, as often as there are `iterations`; the state, and the last estimate."""
    for most in iterations:
        materials = materials_of(state.theta)
        found = [hyperparameters_of(*one, materials, prior) for one in zip(fields, state.parts, state.log_radiance, strict=True)]
        fields = [
            msgspec.structs.replace(field, temperature=one.temperature, precision=prior.precision(field.lattice.axis, one.factors))
            for field, one in zip(fields, found, strict=True)
        ]
        state = descent.run(fields, state.theta, state.log_radiance, free, most)
    return state, found


def sure_ones(problem: JointProblem) -> JointProblem:
    """The observations that materials are found from: those whose normals are sure, with less noise in the dark."""
    blocks = [block.take(sure(block)) for block in problem.blocks]
    blocks = [block.with_noise(msgspec.structs.replace(block.noise, absolute=DARK * block.noise.absolute)) for block in blocks]
    return msgspec.structs.replace(problem, blocks=blocks)


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


def fields_of(problem: JointProblem, point: Point, prior: LightPrior, lattice: Lattice, hyperparameters: Sequence[Hyperparameters]) -> list[Field]:
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
        for block, light, one in zip(problem.blocks, point.lights, hyperparameters, strict=True)
    ]


def above_zero(materials: Materials, lambertian: Bool[np.ndarray, " m"]) -> Materials:
    """The materials, their reflectances raised to at least `LEAST_AT_START`, except the specular ones of Lambertian materials."""
    specular = np.where(lambertian[:, None], materials.specular, np.maximum(materials.specular, LEAST_AT_START))
    return Materials(np.maximum(materials.diffuse, LEAST_AT_START), specular, materials.roughness)


def constant(block: Block, materials: Materials, lattice: Lattice) -> Float[np.ndarray, "3 p"]:
    """The constant light that explains a block's mean radiance."""
    reflectance = (materials.diffuse + materials.specular)[block.material].mean(0)
    level = np.log(np.maximum(block.radiance.mean(0), 1e-6) / np.maximum(reflectance, LEAST_REFLECTANCE))
    return np.repeat(level[:, None], len(lattice), axis=1)


def hyperparameters_of(field: Field, part: Marginal, log_radiance: Float[np.ndarray, "3 p"], materials: Materials, prior: LightPrior) -> Hyperparameters:
    """By the residuals and the light that a descent ended with; part: its system there."""
    covariance = positive_definite_inverse(part.light_hessian).matrix
    factors = prior.likeliest_factors(field.lattice.axis, log_radiance, covariance)
    return Hyperparameters(temperature(field, shown(field, log_radiance, materials).residual), factors)


def temperature(field: Field, residual: Float[np.ndarray, "n 3"]) -> float:
    """T of (1), from residuals no larger than the robust scale."""
    number, bounded = clusters_of(field.block), residual.clip(-field.robust_scale, field.robust_scale)
    sums = [np.bincount(number, channel) for channel in bounded.T]
    return max(float(np.square(sums).sum()) / max(residual.size, 1), LEAST_TEMPERATURE)
