"""Lights of few lobes: whole answers, which round is chosen, and specular parts kept where held-out observations need them."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import mirror_cells
from factorlib.model import materials as model
from factorlib.model.materials import Materials, Point
from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes import rounds
from factorlib.solve.few_lobes import solve as solving
from factorlib.solve.few_lobes.descent import descend, evaluate, fit_weights
from factorlib.solve.few_lobes.options import FewLobes, Run
from factorlib.solve.few_lobes.rounds import chosen_round, gained
from factorlib.solve.few_lobes.solve import answer_of, few_lobes, with_specular_chosen
from factorlib.stage import serial_map
from studies.scenes.problems import MATERIALS, block, factor_between, random_light
from tests.model.made import three_rooms
from tests.solve.few_lobes.test_descent import ORDER, with_materials_permuted
from tests.solve.made import OPERATOR

QUICK = FewLobes(lobes=10, insert=5, rounds=3, iterations=10, polish=20, tolerance=1e-5)
SHORT = FewLobes(lobes=4, insert=2, rounds=2, iterations=2, polish=2)


def rooms(count=2, lobes=4, size=12, seed=3):
    rng = np.random.default_rng(seed)
    lights = [random_light(rng, lobes) for _ in range(count)]
    return [block(f"room{i}", li, MATERIALS, [0, 1, 2], OPERATOR, size, seed=i) for i, li in enumerate(lights)]


def run(blocks, options, map_=serial_map):
    return few_lobes(JointProblem(blocks, OPERATOR, spread=map_), 3, Run(options))


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


def test_no_lobe_is_sharper_than_the_materials_resolve_and_the_weights_fit_what_is_left(solved, monkeypatch):
    monkeypatch.setattr(model, "RESOLVED", 0.3)  # so that lobes are blurred
    problem, point = solved[0].with_none_held_out(), solved[1].point
    found, sharpest = answer_of(problem, point), np.log(point.materials.sharpest)
    assert all((light.log_sharpness <= sharpest + 1e-12).all() for light in found.lights)
    assert any(light.log_sharpness.max() > sharpest for light in point.lights)
    assert fit_weights(problem, found).loss > 0.99 * evaluate(problem, found).loss


def test_neither_the_unit_of_a_photo_nor_threads_nor_processes_change_a_bit():
    blocks = rooms(3, 3, size=10)
    serial = numbers(run(blocks, SHORT).point)
    brighter = [msgspec.structs.replace(blocks[0], unit=7 * blocks[0].unit), *blocks[1:]]
    np.testing.assert_array_equal(numbers(run(brighter, SHORT).point), serial)  # weights are in units of the block
    with ThreadPoolExecutor(3) as threads, ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as processes:
        for pool in (threads, processes):
            other = run(blocks, SHORT, lambda f, items, pool=pool: list(pool.map(f, items)))
            np.testing.assert_array_equal(numbers(other.point), serial)


def test_exposures_of_photos_that_share_a_light_are_found():
    truth = random_light(np.random.default_rng(5), 3, photos=3)
    data = block("room", truth, MATERIALS, [0, 1, 2], OPERATOR, size=10)
    found = run([data], msgspec.structs.replace(QUICK, polish=20)).point
    np.testing.assert_allclose(found.lights[0].log_exposure, truth.log_exposure, atol=0.01)


def test_the_answer_does_not_depend_on_the_order_of_materials_or_lights():
    """Up to what rounding grows to in a descent that stops within its tolerance."""
    problem, point = three_rooms()
    problem = msgspec.structs.replace(problem, operator=OPERATOR)  # compiled: five times as fast
    how = Run(FewLobes(lobes=6, insert=3, rounds=2, iterations=6, polish=8, specular="on"))
    others = with_materials_permuted(problem, point)[0], problem.restricted([0, 2, 1])
    one, permuted, turned = (few_lobes(of, 3, how).point.materials.rows() for of in (problem, *others))
    np.testing.assert_allclose(permuted, one[ORDER], atol=0.01)
    np.testing.assert_allclose(turned, one, atol=0.01)


# ── rounds ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_gain_is_the_fall_of_the_held_out_loss_and_its_error_that_of_other_draws(solved):
    problem, best = solved[0], solved[1].point
    worse = Point(best.materials, [msgspec.structs.replace(light, weight=1.1 * light.weight) for light in best.lights])
    gain, error = gained(problem, best, worse)
    assert gain == pytest.approx(problem.held_out_loss(best) - problem.held_out_loss(worse))
    difference = np.subtract(*(np.concatenate(problem.held_out_losses(at)) for at in (best, worse)))
    rng = np.random.default_rng(0)
    drawn = [rng.choice(difference, len(difference)).mean() for _ in range(2000)]
    assert error == pytest.approx(np.std(drawn), rel=0.1)
    assert gained(problem, best, best) == (0, 0)


def test_what_held_out_observations_cannot_tell_apart_the_fitted_ones_decide(monkeypatch):
    problem = JointProblem(rooms(size=10), OPERATOR)
    options = FewLobes(lobes=18, insert=6, rounds=3, iterations=8)

    def lost_at(gain):  # the fitted loss, where each round after the first seems to have this gain, ± 1
        seeming = lambda sample, best, point: (np.inf, 0.0) if best is None else (gain, 1.0)  # noqa: E731
        monkeypatch.setattr(rounds, "gained", seeming)
        return evaluate(problem, chosen_round(problem, 3, Run(options)).point).loss

    assert lost_at(-0.9) < 0.5 * lost_at(-1.1)


# ── specular parts ───────────────────────────────────────────────────────────────────────────────────────────────────

MIXED = Materials(
    diffuse=np.array([[0.6, 0.3, 0.2], [0.2, 0.3, 0.4], [0.35, 0.3, 0.4]]),
    specular=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.2, 0.2]]),
    roughness=np.array([0.5, 0.5, 0.35]),
)
CHOOSING = FewLobes(lobes=12, insert=6, polish=4, rounds=2, iterations=12)


def shown_by_two(materials, shown, noise=0.3):
    """Two rooms, of which whole cells are held out, and the point that they show."""
    rng, blocks, lights = np.random.default_rng(11), [], []
    for k in range(2):
        light = random_light(rng, 4)
        data = block(f"room{k}", light, materials, shown, OPERATOR, size=18, seed=k)
        radiance = np.maximum(data.radiance + noise * rng.normal(size=data.radiance.shape) / data.precision, 0)
        _, cell = np.unique(mirror_cells(data.normal, data.view, 0.2), return_inverse=True)
        held_out = (rng.random(cell.max() + 1) < 0.15)[cell.reshape(-1)]
        blocks.append(msgspec.structs.replace(data, radiance=radiance, held_out=held_out))
        lights.append(msgspec.structs.replace(light, weight=light.weight / data.unit))
    return JointProblem(blocks, OPERATOR), Point(materials, lights)


@pytest.fixture(scope="module")
def mixed():
    """The problem, the chosen round, and which specular parts are kept."""
    problem, _ = shown_by_two(MIXED, [0, 1, 2])
    fit = chosen_round(problem, 3, Run(CHOOSING))
    return problem, fit, with_specular_chosen(problem, fit, Run(CHOOSING))


def test_lambertian_materials_lose_their_specular_part_and_glossy_ones_keep_it_whether_few_lights_decide_or_all(
    mixed, monkeypatch
):
    problem, fit, found = mixed
    assert found.lambertian.tolist() == [True, True, False]
    assert found.evidence[2].held_out_loss_without > 1.05 * found.evidence[2].held_out_loss_with
    monkeypatch.setattr(solving, "LIGHTS", 1)
    few = with_specular_chosen(problem, fit, Run(CHOOSING))
    assert few.lambertian.tolist() == [True, True, False] and len(few.point.lights) == 2


def test_a_lambertian_scene_ends_without_specular_and_with_few_lobes(mixed):
    found = few_lobes(shown_by_two(MIXED, [0, 1])[0], 3, Run(CHOOSING))
    assert found.lambertian[:2].all() and (found.point.materials.specular[:2] == 0).all()
    assert sum(map(len, found.point.lights)) <= 1.2 * sum(map(len, mixed[1].point.lights))


@pytest.mark.parametrize("specular", ["on", "off"])
def test_nothing_is_chosen_where_it_is_not_asked_for(mixed, specular):
    how = msgspec.structs.replace(SHORT, specular=specular)
    found = few_lobes(mixed[0].sampled(200, 0), 3, Run(how))
    assert found.lambertian.all() == found.lambertian.any() == (specular == "off") and found.specular == []
    assert (found.point.materials.specular.any() == 0) == (specular == "off")


def test_what_shines_more_than_it_scatters_is_not_tried(mixed):
    _, fit, _ = mixed
    rows = fit.point.materials.rows()
    rows[2, :3] /= 5
    glossy = msgspec.structs.replace(fit, point=Point(Materials.of_rows(rows), fit.point.lights))
    found = with_specular_chosen(mixed[0], glossy, Run(CHOOSING))
    assert not found.lambertian[2] and found.evidence[2].held_out_loss_without is None


def test_a_descent_that_spoils_what_is_held_out_decides_nothing(mixed, monkeypatch):
    """Out of sight of the fit, a lobe may grow where held-out observations alone mirror it: here it does where all have specular parts."""

    def spoiled(problem, start, *arguments, fixed, **options):
        at = descend(problem, start, *arguments, fixed=fixed, **options)
        factor = 1 if fixed.any() else 3
        lights = [msgspec.structs.replace(light, weight=factor * light.weight) for light in at.point.lights]
        return msgspec.structs.replace(at, point=Point(at.point.materials, lights))

    problem = mixed[0].of([b.take(b.material == 2) for b in mixed[0].blocks])
    monkeypatch.setattr(solving, "descend", spoiled)
    assert with_specular_chosen(problem, mixed[1], Run(CHOOSING)).evidence[2].kept


def test_a_material_is_judged_by_its_held_out_observations_but_may_not_harm_the_others(monkeypatch):
    problem, truth = shown_by_two(MIXED, [0, 1, 2], noise=0.0)
    rows = truth.materials.rows()
    rows[0, :3] *= 1.2
    brighter = [msgspec.structs.replace(light, weight=1.01 * light.weight) for light in truth.lights]
    pair = Point(Materials.of_vector(rows.reshape(-1)), truth.lights), Point(truth.materials, brighter)
    monkeypatch.setattr(solving, "HARM", 1e9)
    assert solving.compare(problem, *pair, 0).kept and not solving.compare(problem, *pair, 1).kept
    monkeypatch.setattr(solving, "HARM", 0.0)
    assert solving.compare(problem, *pair, 1).kept
    fitted = [np.where(b.held_out[:, None], b.radiance, 7.0) for b in problem.blocks]
    other = problem.of([msgspec.structs.replace(b, radiance=r) for b, r in zip(problem.blocks, fitted, strict=True)])
    assert solving.compare(other, *pair, 0) == solving.compare(problem, *pair, 0)
