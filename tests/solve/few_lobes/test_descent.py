"""The arrow-shaped system against the same system written out whole, its limits, and the order of materials and lights."""

import numpy as np
import pytest

from factorlib.model.materials import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.arrow import FLOOR
from factorlib.solve.few_lobes.descent import DEFINITE, Bounds, damped_step, evaluate
from factorlib.solve.few_lobes.unknowns import moved_point
from studies.scenes.problems import MATERIALS, block, random_light
from tests.model.made import OPERATOR

DAMPING = 1e-2
EVERY = np.ones(7 * len(MATERIALS), bool)
SHOWN = ([0, 2], [1, 2])  # the materials of each light


def close(found, expected, rtol=1e-6, atol=1e-9):
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol * np.abs(expected).max())


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(2)
    blocks = [
        block(f"room{k}", random_light(rng, 4, photos), MATERIALS, SHOWN[k], OPERATOR, size=12)
        for k, photos in enumerate((1, 2))
    ]
    return JointProblem(blocks, OPERATOR)


@pytest.fixture(scope="module")
def iterate(problem):
    """Two lights of unlike sizes, away from any optimum and from all bounds."""
    rng = np.random.default_rng(3)
    return evaluate(problem, Point(MATERIALS, [random_light(rng, *of) for of in ((3, 1), (5, 2))]))


@pytest.fixture(scope="module")
def dense(iterate):
    """H and g of all unknowns, the materials first."""
    sizes = [len(part.light_gradient) for part in iterate.parts]
    size, at = len(EVERY) + sum(sizes), len(EVERY)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    for part, shown, count in zip(iterate.parts, SHOWN, sizes, strict=True):
        places = [*(7 * m + k for m in shown for k in range(7)), *range(at, at + count)]
        blocks = [[part.material_hessian, part.cross_hessian], [part.cross_hessian.T, part.light_hessian]]
        hessian[np.ix_(places, places)] += np.block(blocks)
        gradient[places] += np.concatenate([part.material_gradient, part.light_gradient])
        at += count
    return hessian, gradient


def blocks_damped(hessian, iterate, damping):
    """The dense Hessian with every block's diagonal damped as the solver does."""
    hessian, at = hessian.copy(), 0
    for size in (len(EVERY), *(len(part.light_gradient) for part in iterate.parts)):
        own = range(at, at + size)
        diagonal = hessian[own, own].copy()
        floor = FLOOR * diagonal.max()
        hessian[own, own] += damping * np.maximum(diagonal, floor) + floor
        at += size
    return hessian


def unbounded(iterate):
    bounds = [Bounds(part, light, MATERIALS) for part, light in zip(iterate.parts, iterate.point.lights, strict=True)]
    assert all(bound.free.all() for bound in bounds)
    return bounds


def test_what_is_fixed_is_what_a_dense_solve_of_the_rest_leaves_out(iterate, dense):
    free, bounds = EVERY.copy(), unbounded(iterate)
    free[[0, 9]] = False
    bounds[0].free[[2, 7]], bounds[1].free[4], bounds[1].fixed[4] = False, False, 0.05
    by_materials, by_lights = iterate.solved(free, bounds, DAMPING)
    hessian, (whole, gradient) = blocks_damped(dense[0], iterate, DAMPING), dense
    loose = np.concatenate([free, *(bound.free for bound in bounds)])
    expected = np.concatenate([np.zeros(len(free)), *(bound.fixed for bound in bounds)])
    right = -(gradient + whole @ expected)
    expected[loose] = np.linalg.solve(hessian[np.ix_(loose, loose)], right[loose])
    close(np.concatenate([by_materials, *by_lights]), expected)


def test_the_information_is_the_inverse_of_the_materials_part_of_the_dense_inverse(iterate, dense):
    hessian, m = dense[0], len(EVERY)
    light = blocks_damped(hessian, iterate, DEFINITE)[m:, m:]
    expected = hessian[:m, :m] - hessian[:m, m:] @ np.linalg.solve(light, hessian[m:, :m])
    found, _ = iterate.information()
    close(found, expected, 1e-5, 1e-8)
    np.testing.assert_array_equal(found, found.T)


def test_a_small_step_lowers_the_loss_by_the_decrease_that_the_quadratic_model_predicts(problem, iterate, dense):
    dm, dl, predicted = damped_step(iterate, DAMPING)
    whole, (hessian, gradient) = np.concatenate([dm, *dl]), dense
    assert predicted == pytest.approx(-(2 * gradient @ whole + whole @ hessian @ whole), rel=1e-9) and predicted > 0
    dm, dl, predicted = damped_step(iterate, 1e4)  # where the quadratic model holds
    gained = iterate.loss - evaluate(problem, moved_point(iterate.point, dm, dl)).loss
    assert gained == pytest.approx(predicted, rel=0.02)
