import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import msgspec
import numpy as np
import pytest

from factorlib.model import bounds
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.descent import evaluate, fit_weights
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.rounds import answer_of, chosen_round, gained
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.stage import serial_map
from studies.scenes.problems import MATERIALS, block, factor_between, random_light

OPERATOR = reflection_operator("network")
QUICK = FewLobes(lobes=12, insert=6, rounds=3, iterations=20, polish=60, tolerance=1e-5)


def rooms(count=2, lobes=4, photos=1, seed=3):
    rng = np.random.default_rng(seed)
    return [
        block(f"room{i}", random_light(rng, lobes, photos), MATERIALS, [0, 1, 2], OPERATOR, seed=i)
        for i in range(count)
    ]


def run(blocks, materials=3, options=QUICK):
    solution = few_lobes(JointProblem(blocks, OPERATOR), materials, Run(options))
    return solution.point.materials, solution.point.lights, solution.history


@pytest.fixture(scope="module")
def solved():
    blocks = rooms()
    return blocks, *run(blocks)


def test_recovers_the_materials_it_was_rendered_with(solved):
    _, materials, _, _ = solved
    factor = factor_between(materials, MATERIALS)
    np.testing.assert_allclose(materials.roughness, MATERIALS.roughness, atol=0.05)
    np.testing.assert_allclose(materials.diffuse * factor, MATERIALS.diffuse, rtol=0.15, atol=0.01)


def test_resynthesises_what_it_was_shown(solved):
    blocks, materials, lights, _ = solved
    for data, radiance in zip(blocks, JointProblem(blocks, OPERATOR).radiance(Point(materials, lights)), strict=True):
        error = radiance - data.radiance
        assert np.sqrt(np.mean(error**2)) < 0.03 * np.quantile(data.radiance, 0.99)


def test_no_lobe_is_sharper_than_the_materials_resolve_and_the_weights_fit_what_is_left(solved, monkeypatch):
    monkeypatch.setattr(bounds, "RESOLVED", 0.3)  # so that lobes are blurred
    blocks, materials, lights, _ = solved
    problem = JointProblem(blocks, OPERATOR).with_none_held_out()
    found = answer_of(problem, Point(materials, lights))
    assert all((light.log_sharpness <= np.log(materials.sharpest) + 1e-12).all() for light in found.lights)
    assert any(light.log_sharpness.max() > np.log(materials.sharpest) for light in lights)
    assert fit_weights(problem, found).loss > 0.99 * evaluate(problem, found).loss


def test_lights_are_not_negative_and_finite(solved):
    for light in solved[2]:
        assert (light.weight >= 0).all()
        assert np.isfinite(light.weight).all() and np.isfinite(light.axis).all()


def test_loss_never_rises_within_a_descent(solved):
    events = [e for e in solved[3] if e.phase == "descent"]
    for a, b in zip(events, events[1:], strict=False):
        if a.round == b.round:
            assert b.loss <= a.loss


def test_scaling_a_photo_scales_its_light_alone(solved):
    blocks, materials, lights, _ = solved
    brighter = [msgspec.structs.replace(blocks[0], unit=7 * blocks[0].unit), *blocks[1:]]
    again, same, _ = run(brighter)
    np.testing.assert_array_equal(again.vector(), materials.vector())
    np.testing.assert_array_equal(same[0].weight, lights[0].weight)  # in units of the block, which carries the 7


def test_exposures_of_photos_that_share_a_light_are_found():
    rng = np.random.default_rng(5)
    truth = random_light(rng, 3, photos=3)
    data = block("room", truth, MATERIALS, [0, 1, 2], OPERATOR, size=16)
    _, lights, _ = run([data])
    np.testing.assert_allclose(lights[0].log_exposure, truth.log_exposure, atol=0.01)


def test_neither_threads_nor_processes_change_a_bit():
    operator = reflection_operator("network")
    rng = np.random.default_rng(9)
    blocks = [
        block(f"room{i}", random_light(rng, 3), MATERIALS, [0, 1, 2], operator, size=12, seed=i) for i in range(3)
    ]
    options = FewLobes(lobes=4, insert=2, rounds=2, iterations=2, polish=2)

    def answer(map_):
        point = few_lobes(JointProblem(blocks, operator, spread=map_), 3, Run(options)).point
        return np.concatenate(
            [point.materials.vector(), *(v.reshape(-1) for li in point.lights for v in (li.axis, li.weight))]
        )

    serial = answer(serial_map)
    with ThreadPoolExecutor(3) as threads, ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:
        for pool in (threads, processes):
            np.testing.assert_array_equal(answer(lambda f, items, pool=pool: list(pool.map(f, items))), serial)


def test_a_gain_is_the_fall_of_the_held_out_loss_and_its_error_that_of_other_draws(solved):
    blocks, materials, lights, _ = solved
    problem, best = JointProblem(blocks, OPERATOR), Point(materials, lights)
    worse = Point(materials, [msgspec.structs.replace(light, weight=1.1 * light.weight) for light in lights])
    gain, error = gained(problem, best, worse)
    assert gain == pytest.approx(problem.held_out_loss(best) - problem.held_out_loss(worse))
    difference = np.subtract(*(np.concatenate(problem.held_out_losses(at)) for at in (best, worse)))
    rng = np.random.default_rng(0)
    drawn = [rng.choice(difference, len(difference)).mean() for _ in range(2000)]
    assert error == pytest.approx(np.std(drawn), rel=0.1)
    assert gained(problem, best, best) == (0, 0)


def test_what_held_out_observations_cannot_tell_apart_the_fitted_ones_decide(monkeypatch):
    problem = JointProblem(rooms(), OPERATOR)
    options = msgspec.structs.replace(QUICK, lobes=18, insert=6, rounds=3)

    def lost_at(gain):  # the fitted loss, where each round after the first seems to have this gain, ± 1
        monkeypatch.setattr(
            "factorlib.solve.few_lobes.rounds.gained",
            lambda sample, best, point: (np.inf, 0.0) if best is None else (gain, 1.0),
        )
        return evaluate(problem, chosen_round(problem, 3, Run(options)).point).loss

    assert lost_at(-0.9) < 0.5 * lost_at(-1.1)
