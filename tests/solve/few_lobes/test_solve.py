"""Lights of few lobes: whole answers, which round is chosen, and specular parts kept where held-out observations need them."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import mirror_cells
from factorlib.model.materials import Materials, Point
from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes import solve as solving
from factorlib.solve.few_lobes.rounds import chosen_round
from factorlib.solve.few_lobes.solve import few_lobes, with_specular_chosen
from factorlib.solve.history import unreported
from factorlib.solve.options import FewLobes
from factorlib.stage import serial_map
from studies.scenes.problems import MATERIALS, block, factor_between, random_light
from tests.model.made import in_units_of
from tests.solve.made import OPERATOR

QUICK = FewLobes(lobes=10, insert=5, rounds=3, iterations=10, polish=20)
SHORT = FewLobes(lobes=4, insert=2, rounds=2, iterations=2, polish=2)


def rooms(count=2, lobes=4, size=12):
    rng = np.random.default_rng(3)
    lights = [random_light(rng, lobes) for _ in range(count)]
    return [block(f"room{i}", li, MATERIALS, [0, 1, 2], OPERATOR, size, seed=i) for i, li in enumerate(lights)]


def run(blocks, options, map_=serial_map):
    return few_lobes(JointProblem(blocks, OPERATOR, spread=map_), 3, options)


def numbers(point):
    return np.concatenate([point.materials.vector(), *(v.ravel() for li in point.lights for v in (li.axis, li.weight))])


@pytest.fixture(scope="module")
def solved():
    blocks = rooms()
    return JointProblem(blocks, OPERATOR), run(blocks, QUICK)


def test_recovers_the_materials_and_the_radiance_it_was_rendered_with(solved):
    problem, found = solved[0], solved[1].point
    factor = factor_between(found.materials, MATERIALS)
    np.testing.assert_allclose(found.materials.roughness, MATERIALS.roughness, atol=0.05)
    np.testing.assert_allclose(found.materials.diffuse * factor, MATERIALS.diffuse, rtol=0.15, atol=0.01)
    for data, radiance in zip(problem.blocks, problem.radiance(found), strict=True):
        assert np.sqrt(np.mean((radiance - data.radiance) ** 2)) < 0.03 * np.quantile(data.radiance, 0.99)
    for light in found.lights:
        assert (light.weight >= 0).all() and np.isfinite(light.weight).all() and np.isfinite(light.axis).all()


def test_loss_never_rises_within_a_descent(solved):
    events = [e for e in solved[1].history if e.phase == "descent"]
    assert all(b.loss <= a.loss for a, b in zip(events, events[1:], strict=False) if a.round == b.round)


def test_neither_the_unit_of_a_photo_nor_threads_nor_processes_change_a_bit():
    blocks = rooms(3, 3, size=10)
    serial = numbers(run(blocks, SHORT).point)
    brighter = [msgspec.structs.replace(blocks[0], unit=7 * blocks[0].unit), *blocks[1:]]
    np.testing.assert_array_equal(numbers(run(brighter, SHORT).point), serial)  # weights are in units of the block
    with ThreadPoolExecutor(3) as threads, ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as processes:
        for pool in (threads, processes):
            other = run(blocks, SHORT, lambda f, items, pool=pool: list(pool.map(f, items)))
            np.testing.assert_array_equal(numbers(other.point), serial)


# ── specular parts ───────────────────────────────────────────────────────────────────────────────────────────────────

MIXED = Materials(
    diffuse=np.array([[0.6, 0.3, 0.2], [0.2, 0.3, 0.4], [0.35, 0.3, 0.4]]),
    specular=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.2, 0.2]]),
    roughness=np.array([0.5, 0.5, 0.35]),
)
CHOOSING = FewLobes(lobes=12, insert=6, polish=4, rounds=2, iterations=12)


def shown_by_two(materials, shown):
    """Two rooms, of which whole cells are held out, and the point that they show."""
    rng, blocks, lights = np.random.default_rng(11), [], []
    for k in range(2):
        light = random_light(rng, 4)
        data = block(f"room{k}", light, materials, shown, OPERATOR, size=18, seed=k)
        radiance = np.maximum(data.radiance + 0.3 * rng.normal(size=data.radiance.shape) / data.precision, 0)
        _, cell = np.unique(mirror_cells(data.normal, data.view, 0.2), return_inverse=True)
        held_out = (rng.random(cell.max() + 1) < 0.15)[cell.reshape(-1)]
        blocks.append(msgspec.structs.replace(data, radiance=radiance, held_out=held_out))
        lights.append(light)
    return JointProblem(blocks, OPERATOR), Point(materials, in_units_of(blocks, lights))


@pytest.fixture(scope="module")
def mixed():
    """The problem, the chosen round, and which specular parts are kept."""
    problem, _ = shown_by_two(MIXED, [0, 1, 2])
    fit = chosen_round(problem, 3, CHOOSING, unreported)
    return problem, fit, with_specular_chosen(problem, fit, CHOOSING)


def test_lambertian_materials_alone_lose_their_specular_part_whether_few_lights_decide_or_all(mixed, monkeypatch):
    problem, fit, found = mixed
    assert found.lambertian.tolist() == [True, True, False]
    assert found.evidence[2].held_out_loss_without > 1.05 * found.evidence[2].held_out_loss_with
    monkeypatch.setattr(solving, "LIGHTS", 1)
    few = with_specular_chosen(problem, fit, CHOOSING)
    assert few.lambertian.tolist() == [True, True, False] and len(few.point.lights) == 2
