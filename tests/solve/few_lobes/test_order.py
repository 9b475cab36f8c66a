"""Laws of the joint problem with few lobes: nothing depends on the order of materials or lights."""

import msgspec
import numpy as np
import pytest

from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.descent import damped_step, evaluate
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.solve import few_lobes
from tests.model.made import three_rooms

ORDER = [2, 0, 1]  # material k of the permuted problem is material ORDER[k] of the other


@pytest.fixture(scope="module")
def given():
    return three_rooms()


def with_materials_permuted(problem, point):
    blocks = []
    for b in problem.blocks:
        number = np.argsort(ORDER)[b.material]
        blocks.append(msgspec.structs.replace(b, material=number).take(np.argsort(number, kind="stable")))
    materials = Materials.of_vector(point.materials.rows()[ORDER].reshape(-1))
    return msgspec.structs.replace(problem, blocks=blocks), Point(materials, point.lights)


def test_materials_in_another_order_take_the_same_step(given):
    problem, point = given
    one, other = (evaluate(p, at) for p, at in (given, with_materials_permuted(*given)))
    assert one.loss == pytest.approx(other.loss, rel=1e-12)
    a, b = damped_step(one, 1e-3), damped_step(other, 1e-3)
    np.testing.assert_allclose(a.materials.reshape(-1, 7)[ORDER], b.materials.reshape(-1, 7), rtol=1e-6, atol=1e-9)
    for first, second in zip(a.lights, b.lights, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-9)


def test_lights_in_another_order_take_the_same_step(given):
    problem, point = given
    order = [1, 2, 0]
    one, other = (evaluate(p, at) for p, at in (given, (problem.restricted(order), point.restricted(order))))
    a, b = damped_step(one, 1e-3), damped_step(other, 1e-3)
    np.testing.assert_allclose(a.materials, b.materials, rtol=1e-6, atol=1e-9)
    for k, second in zip(order, b.lights, strict=True):
        np.testing.assert_allclose(a.lights[k], second, rtol=1e-6, atol=1e-9)


def test_the_answer_does_not_depend_on_the_order_of_materials_or_lights(given):
    """Up to what rounding grows to in a descent that stops within its tolerance."""
    problem, _ = given
    problem = msgspec.structs.replace(problem, operator=reflection_operator("network"))  # compiled: five times as fast
    run = lambda: Run(FewLobes(lobes=6, insert=3, rounds=2, iterations=6, polish=8, specular="on"))  # noqa: E731
    one = few_lobes(problem, 3, run()).point.materials
    permuted = few_lobes(with_materials_permuted(problem, given[1])[0], 3, run()).point.materials
    turned = few_lobes(problem.restricted([0, 2, 1]), 3, run()).point.materials
    np.testing.assert_allclose(permuted.rows(), one.rows()[ORDER], atol=0.01)
    np.testing.assert_allclose(turned.rows(), one.rows(), atol=0.01)


def test_spreading_work_is_serial_work(given):
    problem, point = given
    spread = msgspec.structs.replace(problem, spread=lambda f, items: [f(item) for item in reversed(list(items))][::-1])
    one, other = evaluate(problem, point), evaluate(spread, point)
    np.testing.assert_array_equal(one.system.material_hessian, other.system.material_hessian)
