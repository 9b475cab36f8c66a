"""The one way to decide between two models."""

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, random_light
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.evidence import Candidates, compare, compare_by_light, decide_over_lights
from factorlib.solve.thresholds import Threshold

OPERATOR = reflection_operator("closed_form", dtype="float64")


def two_lights():
    rng = np.random.default_rng(0)
    lights = [random_light(rng, 3) for _ in range(2)]
    blocks = [block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR, size=12, seed=k) for k, light in enumerate(lights)]
    scaled = [msgspec.structs.replace(light, weight=light.weight / b.unit) for b, light in zip(blocks, lights, strict=True)]
    return JointProblem(blocks, OPERATOR), Point(MATERIALS, scaled)


def brighter(point, factor, lights=(0, 1)):
    scaled = [msgspec.structs.replace(li, weight=li.weight * factor) if k in lights else li for k, li in enumerate(point.lights)]
    return Point(point.materials, scaled)


def test_the_richer_model_stays_only_where_it_gains_more_than_the_threshold():
    problem, truth = two_lights()
    good, poor = brighter(truth, 1.10), brighter(truth, 1.12)
    found = compare(problem, Candidates(poor, good), Threshold(gain=0.0))
    assert found.kept and found.held_out_loss_with == problem.held_out_loss(good)
    gain = problem.held_out_loss(poor) / problem.held_out_loss(good) - 1
    assert compare(problem, Candidates(poor, good), Threshold(gain=0.99 * gain)).kept
    assert not compare(problem, Candidates(poor, good), Threshold(gain=1.01 * gain)).kept
    assert not compare(problem, Candidates(good, good), Threshold(gain=0.0)).kept


def test_what_is_fitted_has_no_say():
    problem, truth = two_lights()
    radiance = [np.where(b.held_out[:, None], b.radiance, 7.0) for b in problem.blocks]
    other = msgspec.structs.replace(
        problem, blocks=[msgspec.structs.replace(b, radiance=r) for b, r in zip(problem.blocks, radiance, strict=True)]
    )
    pair = Candidates(brighter(truth, 1.2), brighter(truth, 1.1))
    assert compare(problem, pair, Threshold(0.0)) == compare(other, pair, Threshold(0.0))


def test_a_material_is_judged_by_its_own_observations_but_may_not_harm_the_others():
    problem, truth = two_lights()
    rows = truth.materials.rows()
    rows[0, :3] *= 1.2
    pair = Candidates(Point(type(MATERIALS).of_vector(rows.reshape(-1)), truth.lights), brighter(truth, 1.01))
    assert compare(problem, pair, Threshold(gain=1.0), material=0).kept
    assert not compare(problem, pair, Threshold(gain=1.0), material=1).kept
    assert compare(problem, pair, Threshold(gain=1.0, harm=0.0), material=1).kept


def test_each_light_is_judged_by_its_own_observations_and_none_held_out_is_no_evidence():
    problem, truth = two_lights()
    without = brighter(truth, 1.2, lights=[1])
    assert [one.kept for one in compare_by_light(problem, [without], truth, Threshold(0.25))] == [False, True]
    assert not any(one.kept for one in compare_by_light(problem, [without, truth], truth, Threshold(0.25)))
    blocks = [problem.blocks[0], problem.blocks[1].with_none_held_out()]
    assert not compare_by_light(msgspec.structs.replace(problem, blocks=blocks), [without], truth, Threshold(0.25))[1].kept


def test_over_lights_each_counts_relative_to_itself():
    """The third light is explained badly, and a little worse by the richer model: its sum would outweigh what the others gain."""
    one, other = np.array([0.5, 1.5]), np.array([1.0, 2.0, 3.0, 2.0])
    without, richer = [one, one, 100 * other], [one / 2, one / 2, 101 * other]
    assert sum(losses.sum() for losses in richer) > sum(losses.sum() for losses in without)
    found = decide_over_lights(without, richer, Threshold(0.1))
    assert found.kept and not decide_over_lights(richer, without, Threshold(0.1)).kept
    logarithms = np.log([[1, 1, 200], [0.5, 0.5, 202]]) @ [0.25, 0.25, 0.5]  # by their counts
    np.testing.assert_allclose([found.held_out_loss_without, found.held_out_loss_with], np.exp(logarithms))
    nothing = np.zeros(0)
    assert decide_over_lights([nothing, one], [nothing, one / 2], Threshold(0.1)).held_out_loss_without == pytest.approx(1.0)
    assert not decide_over_lights([nothing], [nothing], Threshold(0.0)).kept
    exact = np.full(5, 1e-9)
    assert not decide_over_lights([2 * exact], [exact], Threshold(0.1)).kept, "below what the operator errs by, nothing is a gain"
