"""The one way to decide between two models."""

import msgspec
import numpy as np

from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.evidence import Candidates, compare
from factorlib.solve.few_lobes.thresholds import Threshold
from tests.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("closed_form", dtype="float64")


def two_lights():
    rng = np.random.default_rng(0)
    lights = [random_light(rng, 3) for _ in range(2)]
    blocks = [
        block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR, size=12, seed=k) for k, light in enumerate(lights)
    ]
    scaled = [
        msgspec.structs.replace(light, weight=light.weight / b.unit) for b, light in zip(blocks, lights, strict=True)
    ]
    return JointProblem(blocks, OPERATOR), Point(MATERIALS, scaled)


def brighter(point, factor, lights=(0, 1)):
    scaled = [
        msgspec.structs.replace(li, weight=li.weight * factor) if k in lights else li
        for k, li in enumerate(point.lights)
    ]
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
