"""Problems in natural lights whose answer is known: lights on cells, drawn from the prior, and what spheres show of them."""

from functools import cache

import msgspec
import numpy as np

from factorlib.inference.fit.fit import Fit, FitSchedule, Hyperparameters, fit_problem, initial_fit, light_likelihood
from factorlib.inference.fit.likelihood import LightLikelihood
from factorlib.inference.fit.start import constant_light, rotated_cells
from factorlib.inference.model.blocks import RobustLoss
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.lights import PEAK, Light, fibonacci_cells
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.problem import JointProblem
from factorlib.light.prior import MIX, read_light_prior
from factorlib.reflection import reflection_operator
from factorlib.scenes.joint_problems import MATERIALS, sphere_block
from tests.inference.made import in_units_of

FEW = 120  # cells, so that tests are quick
OPERATOR, PRIOR = reflection_operator("network"), read_light_prior()
START = Materials(np.full((3, 3), 0.3), np.full((3, 3), 0.1), np.full(3, 0.4))
WHOLE = FitSchedule(4, (14, 10))


def drawn(seed: int, cells: int) -> np.ndarray:
    """Log radiance [3, p] drawn from the prior, without the level of its exposure."""
    rng, axis, fields = np.random.default_rng(seed), fibonacci_cells(cells).axis, []
    for k in range(3):
        covariance = PRIOR.covariance(k, axis) - (PRIOR.level[0] if k == 0 else 0.0)
        fields.append(np.linalg.cholesky(covariance + 1e-9 * np.eye(cells)) @ rng.normal(size=cells))
    return np.linalg.solve(MIX, fields)


def on_even_cells(u: np.ndarray, log_exposure=(0.0,), log_tone=(), name=None) -> Light:
    """The light of log radiance u [3, p] on even cells, turned as a solve turns those of the illumination `name`, where it is given."""
    lobes = fibonacci_cells(u.shape[1]) if name is None else rotated_cells(name, u.shape[1])
    return Light(lobes.axis, np.log(lobes.sharpness), PEAK * np.exp(u.T), np.array(log_exposure), np.array(log_tone))


def light_of(axes, sharpness, weights) -> Light:
    """Lobes at `axes`, of those sharpnesses and weights [p, 3]."""
    axes = np.asarray(axes, float)
    sharpness = np.broadcast_to(np.asarray(sharpness, float), len(axes))
    weight = np.array(np.broadcast_to(np.asarray(weights, float), (len(axes), 3)))
    return Light(axes / np.linalg.norm(axes, axis=1, keepdims=True), np.log(sharpness), weight, np.zeros(1))


def spheres(lights, materials=MATERIALS, shown=(0, 1, 2), size=14, noise=0.3, seed=0) -> JointProblem:
    """Noisy spheres of `shown` materials in each of the lights, named room0 and so on."""
    blocks, rng = [], np.random.default_rng(seed)
    for k, light in enumerate(lights):
        clean = sphere_block(f"room{k}", light, materials, list(shown), OPERATOR, size=size)
        noisy = clean.radiance + noise * rng.normal(size=clean.radiance.shape) / clean.inverse_sigma
        blocks.append(msgspec.structs.replace(clean, radiance=np.maximum(noisy, 0.0)))
    return JointProblem(blocks, OPERATOR)


def photographed(seed: int, lights: int, cells: int = FEW, **how) -> tuple[JointProblem, list[Light]]:
    """Spheres in lights drawn from the prior, and the lights in the blocks' units."""
    true = [on_even_cells(drawn(100 * seed + k, cells)) for k in range(lights)]
    problem = spheres(true, seed=seed, **{"size": 16} | how)
    return problem, in_units_of(problem.blocks, true)


def begun(problem: JointProblem, cells: int = FEW, materials: Materials = START) -> Fit:
    """The start of a fit: wrong materials in constant lights."""
    return initial_fit(Point(materials, [constant_light(one, materials, cells) for one in problem.blocks]))


@cache
def natural() -> tuple[JointProblem, list[Light], Fit]:
    """Spheres in three lights drawn from the prior, the lights, and the fit."""
    problem, true = photographed(5, 3)
    return problem, true, fit_problem(problem, begun(problem), PRIOR, WHOLE)


def likelihood(problem, light, materials=MATERIALS, temperature=2.0, prior=PRIOR) -> LightLikelihood:
    """That of the first illumination, without outliers."""
    one = Illumination(problem.blocks[0], light, materials, OPERATOR)
    return msgspec.structs.replace(light_likelihood(one, Hyperparameters(temperature), prior), loss=RobustLoss(1e3))
