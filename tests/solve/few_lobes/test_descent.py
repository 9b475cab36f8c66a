"""The arrow-shaped system against the same system written out whole, its limits, and the order of materials and lights."""

import msgspec
import numpy as np
import pytest

from factorlib.model.lights import Light
from factorlib.model.materials import LEAST_REFLECTANCE, ROUGHNESS, Materials, Point
from factorlib.model.problem import JointProblem
from factorlib.solve.descent import FLOOR
from factorlib.solve.few_lobes.descent import DEFINITE, MOST_S, MOST_TURN, MOST_WIDTHS, Bounds, damped_step, evaluate
from factorlib.solve.few_lobes.equations import linearise
from factorlib.solve.few_lobes.unknowns import (
    light_at_bound,
    materials_at_bound,
    moved_light,
    moved_point,
    tangents,
    unknowns,
)
from studies.scenes.problems import MATERIALS, block, random_light
from tests.model.made import OPERATOR, three_rooms

DAMPING = 1e-2
EVERY = np.ones(7 * len(MATERIALS), bool)
SHOWN = ([0, 2], [1, 2])  # the materials of each light
ORDER = [2, 0, 1]  # material k of the permuted problem is material ORDER[k] of the other


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


def test_the_equations_are_those_of_the_jacobian_by_all_unknowns(problem, iterate, dense):
    for found, expected in zip(iterate.of_materials(), (dense[0][:21, :21], dense[1][:21]), strict=True):
        np.testing.assert_array_equal(found, expected)
    for part, one in zip(iterate.parts, problem.illuminations(iterate.point), strict=True):
        hessian = np.zeros((21 + unknowns(one.light),) * 2)
        for some in linearise(one.fitted(), problem.loss):
            hessian[np.ix_(some.places, some.places)] += (some.jacobian.T @ some.jacobian).numpy()
        shown = np.flatnonzero(np.diag(hessian)[:21])
        np.testing.assert_array_equal(part.places, shown)
        close(part.cross_hessian, hessian[shown, 21:], 1e-9, 1e-9)
        close(part.material_hessian, hessian[np.ix_(shown, shown)], 1e-9, 1e-9)


def test_the_step_is_that_of_a_dense_solve(iterate, dense):
    by_materials, by_lights = iterate.solved(EVERY, unbounded(iterate), DAMPING)
    expected = np.linalg.solve(blocks_damped(dense[0], iterate, DAMPING), -dense[1])
    close(np.concatenate([by_materials, *by_lights]), expected)


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


def test_the_predicted_decrease_is_that_of_the_quadratic_model_and_a_small_step_lowers_the_loss_as_predicted(
    problem, iterate, dense
):
    dm, dl, predicted = damped_step(iterate, DAMPING)
    whole, (hessian, gradient) = np.concatenate([dm, *dl]), dense
    assert predicted == pytest.approx(-(2 * gradient @ whole + whole @ hessian @ whole), rel=1e-9) and predicted > 0
    dm, dl, predicted = damped_step(iterate, 1e4)  # where the quadratic model holds
    gained = iterate.loss - evaluate(problem, moved_point(iterate.point, dm, dl)).loss
    assert gained == pytest.approx(predicted, rel=0.02)


def test_no_step_leaves_its_bounds(iterate):
    for damping in (1e-9, 1e-3, 1.0):
        _, dl, _ = damped_step(iterate, damping)
        for light, by in zip(iterate.point.lights, dl, strict=True):
            p, turned = len(light), moved_light(light, by, MATERIALS)
            turn, widths = (
                np.hypot(by[:p], by[p : 2 * p]),
                np.minimum(MOST_WIDTHS / np.sqrt(light.sharpness), MOST_TURN),
            )
            assert (turn <= widths * 1.0001).all() or (np.abs(by[2 * p : 3 * p]) <= MOST_S).all()
            assert (turned.sharpness <= MATERIALS.sharpest * (1 + 1e-9)).all() and (turned.weight >= 0).all()


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
    inward = np.array([-1.0, -1, -1, 1, 1, 1, 1])  # gradients: where negative, the loss falls as the unknown grows
    assert not materials_at_bound(materials, inward).any()
    np.testing.assert_array_equal(materials_at_bound(materials, -inward), [True] * 3 + [False] * 3 + [True])


def test_lobes_without_weight_stay_but_for_a_weight_that_is_asked_for():
    light = Light(np.tile([0.0, 0.0, -1.0], (2, 1)), np.zeros(2), np.array([[0.0, 0, 0], [1, 1, 1]]), np.zeros(1))
    gradient = np.ones(unknowns(light))
    gradient[6] = -1  # more of the first lobe's red would help
    at_bound = light_at_bound(light, MATERIALS, gradient)
    assert at_bound[[0, 2, 4, 8, 10]].all() and not at_bound[[1, 3, 5, 6, 7]].any()


def test_tangents_are_perpendicular_and_unit():
    axis = random_light(np.random.default_rng(1), 50).axis
    frame = np.stack([axis, *tangents(axis)], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)


# ── the order of materials and lights ────────────────────────────────────────────────────────────────────────────────


def with_materials_permuted(problem, point):
    blocks = []
    for b in problem.blocks:
        number = np.argsort(ORDER)[b.material]
        blocks.append(msgspec.structs.replace(b, material=number).take(np.argsort(number, kind="stable")))
    return problem.of(blocks), Point(Materials.of_rows(point.materials.rows()[ORDER]), point.lights)


def test_materials_and_lights_in_another_order_take_the_same_step():
    problem, point = three_rooms()
    order = [1, 2, 0]
    one, permuted, turned = (
        evaluate(*of)
        for of in (
            (problem, point),
            with_materials_permuted(problem, point),
            (problem.restricted(order), point.restricted(order)),
        )
    )
    assert one.loss == pytest.approx(permuted.loss, rel=1e-12)
    (dm, dl, _), (dm_permuted, dl_permuted, _), (dm_turned, dl_turned, _) = (
        damped_step(at, 1e-3) for at in (one, permuted, turned)
    )
    close(dm.reshape(-1, 7)[ORDER], dm_permuted.reshape(-1, 7))
    close(dm, dm_turned)
    for k in range(3):
        close(dl[k], dl_permuted[k])
        close(dl[order[k]], dl_turned[k])


def test_spreading_work_is_serial_work():
    problem, point = three_rooms()
    spread = msgspec.structs.replace(problem, spread=lambda f, items: [f(item) for item in reversed(list(items))][::-1])
    one, other = evaluate(problem, point), evaluate(spread, point)
    np.testing.assert_array_equal(one.of_materials()[0], other.of_materials()[0])
