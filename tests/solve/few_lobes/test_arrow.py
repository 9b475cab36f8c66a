"""The arrow-shaped system against the same system written out whole."""

import numpy as np
import pytest

from factorlib.model.bounds import LEAST_REFLECTANCE, ROUGHNESS
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.descent import FLOOR
from factorlib.solve.few_lobes.arrow import DEFINITE, MOST_S, MOST_TURN, MOST_WIDTHS, Bounds
from factorlib.solve.few_lobes.descent import damped_step, evaluate
from factorlib.solve.few_lobes.jacobian import fit_loss, fitted, linearise
from factorlib.solve.few_lobes.unknowns import (
    light_at_bound,
    materials_at_bound,
    moved_light,
    moved_point,
    unknowns,
)
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("closed_form", dtype="float64")
DAMPING = 1e-2
EVERY = np.ones(7 * len(MATERIALS), bool)
SHOWN = ([0, 2], [1, 2])  # the materials of each light


@pytest.fixture(scope="module")
def iterate():
    """Two lights of unlike sizes, away from any optimum and from all bounds."""
    rng = np.random.default_rng(3)
    lights = [random_light(rng, lobes, photos) for lobes, photos in ((3, 1), (5, 2))]
    return evaluate(JointProblem(blocks(), OPERATOR), Point(MATERIALS, lights))


def blocks():
    rng = np.random.default_rng(2)
    return [
        block(f"room{k}", random_light(rng, 4, photos), MATERIALS, SHOWN[k], OPERATOR, size=12)
        for k, photos in enumerate((1, 2))
    ]


def dense(system):
    """H and g of all unknowns, the materials first."""
    sizes = [len(part.light_gradient) for part in system.parts]
    size, at = len(EVERY) + sum(sizes), len(EVERY)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    for part, shown, count in zip(system.parts, SHOWN, sizes, strict=True):
        places = [*(7 * m + k for m in shown for k in range(7)), *range(at, at + count)]
        blocks = [[part.material_hessian, part.cross_hessian], [part.cross_hessian.T, part.light_hessian]]
        hessian[np.ix_(places, places)] += np.block(blocks)
        gradient[places] += np.concatenate([part.material_gradient, part.light_gradient])
        at += count
    return hessian, gradient


def blocks_damped(system, damping):
    """The dense Hessian with every block's diagonal damped as the solver does."""
    hessian, _ = dense(system)
    at = 0
    for size in (len(system.material_gradient), *(len(part.light_gradient) for part in system.parts)):
        own = range(at, at + size)
        diagonal = hessian[own, own].copy()
        floor = FLOOR * diagonal.max()
        hessian[own, own] += damping * np.maximum(diagonal, floor) + floor
        at += size
    return hessian


def unbounded(iterate):
    bounds = [
        Bounds(part, light, MATERIALS) for part, light in zip(iterate.system.parts, iterate.point.lights, strict=True)
    ]
    assert all(bound.free.all() for bound in bounds)
    return bounds


def fit_loss_of(problem, point):
    return sum(fit_loss(one, problem.loss) for one in problem.illuminations(point))


def test_sums_over_lights_are_those_of_the_dense_system(iterate):
    hessian, gradient = dense(iterate.system)
    np.testing.assert_array_equal(iterate.system.material_hessian, hessian[:21, :21])
    np.testing.assert_array_equal(iterate.system.material_gradient, gradient[:21])


def test_the_equations_are_those_of_the_jacobian_by_all_unknowns(iterate):
    problem = JointProblem(blocks(), OPERATOR)
    for part, one in zip(iterate.system.parts, problem.illuminations(iterate.point), strict=True):
        hessian = np.zeros((21 + unknowns(one.light),) * 2)
        for some in linearise(fitted(one), problem.loss):
            hessian[np.ix_(some.places, some.places)] += (some.jacobian.T @ some.jacobian).numpy()
        shown = np.flatnonzero(np.diag(hessian)[:21])
        np.testing.assert_array_equal(part.places, shown)
        np.testing.assert_allclose(part.cross_hessian, hessian[shown, 21:], rtol=1e-9, atol=1e-9 * hessian.max())
        np.testing.assert_allclose(
            part.material_hessian, hessian[np.ix_(shown, shown)], rtol=1e-9, atol=1e-9 * hessian.max()
        )


def test_the_step_is_that_of_a_dense_solve(iterate):
    by_materials, by_lights = iterate.system.solved(EVERY, unbounded(iterate), DAMPING)
    expected = np.linalg.solve(blocks_damped(iterate.system, DAMPING), -dense(iterate.system)[1])
    np.testing.assert_allclose(
        np.concatenate([by_materials, *by_lights]), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max()
    )


def test_what_is_fixed_is_what_a_dense_solve_of_the_rest_leaves_out(iterate):
    free, bounds = EVERY.copy(), unbounded(iterate)
    free[[0, 9]] = False
    bounds[0].free[[2, 7]], bounds[1].free[4], bounds[1].fixed[4] = False, False, 0.05
    by_materials, by_lights = iterate.system.solved(free, bounds, DAMPING)
    hessian, (whole, gradient) = blocks_damped(iterate.system, DAMPING), dense(iterate.system)
    loose = np.concatenate([free, *(bound.free for bound in bounds)])
    expected = np.concatenate([np.zeros(len(free)), *(bound.fixed for bound in bounds)])
    right = -(gradient + whole @ expected)
    expected[loose] = np.linalg.solve(hessian[np.ix_(loose, loose)], right[loose])
    np.testing.assert_allclose(
        np.concatenate([by_materials, *by_lights]), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max()
    )


def test_the_schur_complement_is_the_inverse_of_the_materials_part_of_the_dense_inverse(iterate):
    hessian, m = dense(iterate.system)[0], len(EVERY)
    light = blocks_damped(iterate.system, DEFINITE)[m:, m:]
    expected = hessian[:m, :m] - hessian[:m, m:] @ np.linalg.solve(light, hessian[m:, :m])
    found = iterate.system.schur_complement(iterate.point)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_array_equal(found, found.T)


def test_the_predicted_decrease_is_that_of_the_quadratic_model(iterate):
    step = damped_step(iterate, DAMPING)
    whole, (hessian, gradient) = np.concatenate([step.materials, *step.lights]), dense(iterate.system)
    assert step.predicted == pytest.approx(-(2 * gradient @ whole + whole @ hessian @ whole), rel=1e-9)
    assert step.predicted > 0


def test_a_small_step_lowers_the_loss_as_predicted(iterate):
    """Where the quadratic model holds: at strong damping."""
    step = damped_step(iterate, 1e4)
    gained = iterate.loss - fit_loss_of(
        JointProblem(blocks(), OPERATOR), moved_point(iterate.point, step.materials, step.lights)
    )
    assert gained == pytest.approx(step.predicted, rel=0.02)


def test_no_step_leaves_its_bounds(iterate):
    for damping in (1e-9, 1e-3, 1.0):
        step = damped_step(iterate, damping)
        for light, by in zip(iterate.point.lights, step.lights, strict=True):
            p = len(light)
            turn, widths = (
                np.hypot(by[:p], by[p : 2 * p]),
                np.minimum(MOST_WIDTHS / np.sqrt(light.sharpness), MOST_TURN),
            )
            assert (turn <= widths * 1.0001).all() or (np.abs(by[2 * p : 3 * p]) <= MOST_S).all()
            moved = moved_light(light, by, MATERIALS.blur)
            assert (moved.sharpness <= MATERIALS.sharpest * (1 + 1e-9)).all() and (moved.weight >= 0).all()


def test_tightening_fixes_a_sharpness_at_the_end_of_its_range_and_damps_a_lobe_that_goes_too_far(iterate):
    bound, light = unbounded(iterate)[0], iterate.point.lights[0]
    p, step = len(light), np.zeros(unknowns(light))
    assert not bound.tighten(step)
    step[2 * p], step[1] = 1e3, 10.0  # the first lobe far sharper than is resolved, the second turned too far
    assert bound.tighten(step)
    assert not bound.free[2 * p] and bound.fixed[2 * p] == bound.high[2 * p]
    s_now, s_end = (-np.log(1 / sharpness + MATERIALS.blur) for sharpness in (light.sharpness[0], MATERIALS.sharpest))
    assert bound.fixed[2 * p] == pytest.approx(s_end - s_now)
    assert (bound.extra[[1, p + 1]] > 0).all() and bound.extra[[0, p]].max() == 0


def test_an_unknown_at_its_bound_stays_where_the_loss_pushes_beyond():
    materials = Materials(np.full((1, 3), LEAST_REFLECTANCE), np.full((1, 3), 0.2), np.array([ROUGHNESS[1]]))
    inward = np.array(
        [-1.0, -1, -1, 1, 1, 1, 1]
    )  # gradients: the loss falls as the unknown grows where they are negative
    assert not materials_at_bound(materials, inward).any()
    np.testing.assert_array_equal(materials_at_bound(materials, -inward), [True] * 3 + [False] * 3 + [True])


def test_lobes_without_weight_stay_but_for_a_weight_that_is_asked_for():
    light = Light(np.tile([0.0, 0.0, -1.0], (2, 1)), np.zeros(2), np.array([[0.0, 0, 0], [1, 1, 1]]), np.zeros(1))
    gradient = np.ones(unknowns(light))
    gradient[6] = -1  # more of the first lobe's red would help
    at_bound = light_at_bound(light, MATERIALS, gradient)
    assert at_bound[[0, 2, 4, 8, 10]].all() and not at_bound[[1, 3, 5, 6, 7]].any()
