"""The descent: the arrow's solution is the dense one, minima that are known are found, and where it ends the gradient is nil."""

import numpy as np
import pytest

from factorlib.inference.fit import fit_problem
from factorlib.inference.optimizer import Arrow, Descent, determinant_terms, minimise_lbfgs
from factorlib.inference.priors import MaterialPrior, material_unknowns
from tests.inference.made_lights import PRIOR, WHOLE, begun, likelihood, photographed


def test_the_arrow_is_solved_as_the_dense_system_is():
    problem, lights = photographed(5, 2, cells=20, size=8)
    systems = [likelihood(problem.select_lights([k]), lights[k]).normal_equations() for k in (0, 1)]
    size, prior = 21, np.eye(21)
    free = np.arange(size) != 3
    ends = np.cumsum([size, *(len(one.light_gradient) for one in systems)])
    dense, right = np.zeros((ends[-1],) * 2), np.random.default_rng(0).normal(size=ends[-1])
    dense[:size, :size] = prior
    for one, first, last in zip(systems, ends, ends[1:], strict=False):
        own = slice(first, last)
        dense[np.ix_(one.places, one.places)] += one.material_hessian
        dense[one.places, own] = one.cross_hessian
        dense[own, one.places] = one.cross_hessian.T
        dense[own, own] = one.light_hessian
    moving = np.append(free, np.ones(ends[-1] - size, bool))
    by_materials, *by_lights = np.split(right, ends[:-1])
    step, of_lights = Arrow(systems, prior, free).solve(by_materials, by_lights)
    expected = np.zeros(ends[-1])
    expected[moving] = np.linalg.solve(dense[np.ix_(moving, moving)], right[moving])
    np.testing.assert_allclose(np.concatenate([step, *of_lights]), expected, rtol=1e-4, atol=1e-5)


def quadratic(x):
    scale = np.array([1e4, 1.0, 1e-2])
    return float(scale @ (x - 1) ** 2), scale * (x - 1)


def valley(x):
    """Return 1e6 times the function of Rosenbrock (1960)."""
    off = np.array([1 - x[0], 10 * (x[1] - x[0] ** 2)])
    slope = np.array([-off[0] - 20 * x[0] * off[1], 10 * off[1]])
    return 1e6 * float(off @ off), 1e6 * slope


@pytest.mark.parametrize(
    ("objective", "size", "metric"),
    [(quadratic, 3, lambda g: g / np.array([1e4, 1.0, 1e-2])), (valley, 2, lambda g: g / 1e8)],
)
def test_minima_that_are_known_are_found(objective, size, metric):
    x = np.zeros(size)
    for _ in range(16):  # each begins at the end of the one before, as on a new factorisation
        x = x + minimise_lbfgs(lambda step, begun=x: objective(begun + step), size, metric)
    np.testing.assert_allclose(x, 1.0, atol=1e-2)


def test_where_a_descent_ends_the_likelihood_has_no_slope_left():
    """Of (1) of the optimizer, in directions that matter: by far less than at the start."""
    problem, _ = photographed(5, 2, cells=40, size=10)
    start = begun(problem, 40)
    found = fit_problem(problem, start, PRIOR, WHOLE)
    prior = MaterialPrior(start.point.materials, problem.blocks)
    descent = Descent(prior, problem.spread, lambda loss: None, np.ones(21, bool))
    sizes = []
    for fit in (start, found):
        lights = fit.point.lights
        ones = [
            likelihood(
                problem.without_held_out().select_lights([k]),
                lights[k],
                fit.point.materials,
                fit.hyperparameters[k].temperature,
            )
            for k in range(2)
        ]
        state = descent.linearise(ones, material_unknowns(fit.point.materials))
        slope = state.prior.gradient + determinant_terms(state.systems, 21)[0]
        for one in state.systems:
            slope[one.places] += one.material_gradient
        sizes.append(np.abs(slope).max())
    assert sizes[1] < 0.05 * sizes[0], sizes
