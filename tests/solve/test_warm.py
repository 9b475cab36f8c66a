"""An earlier solution as a start: what it is taken for, and that the answer is the one from nothing, for less work."""

import logging

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, factor_between, random_light
from factorlib.light.lobes import Lobes
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Gauge, MaterialTable, Model, Reflectance, Tone
from factorlib.results.solution import Earlier
from factorlib.solve import insertion
from factorlib.solve.bundle import solve
from factorlib.solve.descent import Descent, descend
from factorlib.solve.history import Run
from factorlib.solve.iterate import evaluate
from factorlib.solve.options import Bundle
from factorlib.solve.rounds import from_nothing
from factorlib.solve.warm import Propagation, from_earlier, known_of, with_exposures

OPERATOR = reflection_operator("network")
BUNDLE = Bundle(light_prior="none", lobes=16, insert=4, rounds=6, iterations=10, polish=15, tolerance=1e-3)
NAMES = ["red", "green", "blue"]
REFLECTANCE, ROUGHNESS, RADIANCE = 0.01, 0.02, 0.01  # how near two answers are, after one factor per channel; noise is .02


@pytest.fixture(scope="module", autouse=True)
def small_dictionary():
    """Most of the time would go into looking for lobes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(insertion, "DICTIONARY", {1.0: 32, 6.0: 96, 30.0: 200})
        yield


class Counted:
    """The operator, counting the values it gives; one with its derivatives costs three."""

    def __init__(self):
        self.cost = 0

    def __getattr__(self, name):
        return getattr(OPERATOR, name)

    def specular(self, *inputs):
        values = OPERATOR.specular(*inputs)
        self.cost += values.numel()
        return values

    def response(self, roughness, sharpness, no, nz, oz):
        self.cost += 3 * nz.numel()
        return OPERATOR.response(roughness, sharpness, no, nz, oz)


def room(number, shown=(0, 1, 2), photos=1, noise=0.02, unit=1.0, size=10):
    light = random_light(np.random.default_rng(30 + number), 3, photos)
    light = msgspec.structs.replace(light, log_sharpness=np.minimum(light.log_sharpness, 3.5))
    data = block(f"room{number}", light, MATERIALS, list(shown), OPERATOR, size=size, seed=number)
    factor = 1 + noise * np.random.default_rng(100 + number).normal(size=data.radiance.shape)
    return msgspec.structs.replace(data, radiance=data.radiance * factor, unit=unit * data.unit), light


def rooms(*numbers, **how):
    return [room(number, **how)[0] for number in numbers]


def answer(blocks, start=None):
    operator = Counted()
    solution = solve(JointProblem(blocks, operator), start or from_nothing(3), Run(BUNDLE))
    return solution, operator.cost


def written(blocks, materials: Materials, lights, names=NAMES, component=(0, 0, 0), lambertian=(False, False, False)) -> Earlier:
    """As the stage writes it and `read_earlier` reads it."""
    rows = zip(names, materials.diffuse.tolist(), materials.specular.tolist(), materials.roughness.tolist(), strict=True)
    table = MaterialTable(
        {name: Reflectance(tuple(d), tuple(s), r) for name, d, s, r in rows},
        Gauge(component=dict(zip(names, component, strict=True))),
        Model(specular={name: not one for name, one in zip(names, lambertian, strict=True)}),
    )
    lobes = {b.name: Lobes(li.axis, li.sharpness, li.weight * b.unit) for b, li in zip(blocks, lights, strict=True)}
    exposures = {
        p: (float(np.exp(e)),) * 3 for b, li in zip(blocks, lights, strict=True) for p, e in zip(b.photos, li.log_exposure, strict=True)
    }
    return Earlier(table, lobes, exposures)


def of(solution, blocks, count=3):
    found = solution.point.materials
    kept = Materials(found.diffuse[:count], found.specular[:count], found.roughness[:count])
    return written(blocks, kept, solution.point.lights, NAMES[:count], [0] * count, solution.lambertian[:count].tolist())


@pytest.fixture(scope="module")
def three():
    blocks = rooms(0, 1, 2)
    return blocks, *answer(blocks)


def check_same(cold, warm, blocks):
    one, other = warm.point, cold.point
    factor = factor_between(one.materials, other.materials)
    np.testing.assert_allclose(one.materials.diffuse * factor, other.materials.diffuse, atol=REFLECTANCE)
    np.testing.assert_allclose(one.materials.specular * factor, other.materials.specular, atol=REFLECTANCE)
    np.testing.assert_allclose(one.materials.roughness, other.materials.roughness, atol=ROUGHNESS)
    assert (warm.lambertian == cold.lambertian).all()
    for b, light, before in zip(blocks, one.lights, other.lights, strict=True):
        a, c = (Illumination(b, li, p.materials, OPERATOR).radiance() for li, p in ((light, one), (before, other)))
        assert np.sqrt(np.mean(((a - c) / (c + 1)) ** 2)) < RADIANCE


def test_a_fourth_light_from_three_is_the_answer_from_nothing_for_less_than_two_thirds(three):
    blocks, before, _ = three
    more = [*blocks, *rooms(3)]
    (cold, whole), (warm, part) = answer(more), answer(more, from_earlier(of(before, blocks), NAMES, "auto"))
    check_same(cold, warm, more)
    assert part < whole * 2 / 3, part / whole


def test_a_third_material_from_two_is_the_answer_from_nothing_for_less_than_two_thirds(three):
    blocks, cold, whole = three
    fewer = rooms(0, 1, 2, shown=(0, 1))
    earlier, _ = answer(fewer)
    warm, part = answer(blocks, from_earlier(of(earlier, fewer, 2), NAMES, "auto"))
    check_same(cold, warm, blocks)
    assert part < whole * 2 / 3, part / whole


# ── what an earlier solution is taken for, on the truth as the earlier solution ──────────────────────────────────────


def truth(*numbers, **how):
    """Blocks without noise, the true lights in the unit of their block, and what a true solution would have written."""
    made = [room(number, noise=0.0, **how) for number in numbers]
    blocks = [b for b, _ in made]
    shown = [Light(li.axis, li.log_sharpness, li.weight / b.unit * how.get("unit", 1.0), li.log_exposure) for b, li in made]
    return blocks, shown


def begun(earlier, blocks, names=NAMES):
    point = from_earlier(earlier, names, "auto").point(JointProblem(blocks, OPERATOR), BUNDLE)
    return point.materials, point.lights


def explained(blocks, materials, lights, atol=1e-3):
    for b, light in zip(blocks, lights, strict=True):
        np.testing.assert_allclose(Illumination(b, light, materials, OPERATOR).radiance(), b.radiance, atol=atol, rtol=atol)


def test_tone_curves_are_taken_over_where_all_photos_of_a_light_have_one():
    blocks, lights = truth(0, 1)
    earlier = written(blocks, MATERIALS, lights)
    model = msgspec.structs.replace(earlier.table.model, tone={blocks[0].photos[0]: Tone(1.3, blocks[0].unit)})
    earlier = msgspec.structs.replace(earlier, table=msgspec.structs.replace(earlier.table, model=model))
    found = known_of(earlier, NAMES, blocks).lights
    np.testing.assert_allclose(np.exp(found[0].log_tone), [1.3])
    assert len(found[1].log_tone) == 0


def test_what_is_known_is_taken_over_whatever_the_order_and_the_units():
    blocks, lights = truth(0, 1)
    turned = [msgspec.structs.replace(b, unit=7 * b.unit, radiance=b.radiance / 7) for b in reversed(blocks)]  # same scene, other unit
    explained(turned, *begun(written(blocks, MATERIALS, lights), turned))


def test_materials_go_by_their_names():
    blocks, lights = truth(0)
    swapped = Materials(*(getattr(MATERIALS, f)[[2, 0, 1]] for f in MATERIALS.__struct_fields__))
    materials, _ = begun(written(blocks, swapped, lights, ["blue", "red", "green"]), blocks)
    np.testing.assert_array_equal(materials.vector(), MATERIALS.vector())


def test_a_light_nobody_knows_is_found_with_the_materials_fixed():
    blocks, lights = truth(0, 1)
    materials, found = begun(written(blocks[:1], MATERIALS, lights[:1]), blocks)
    np.testing.assert_array_equal(materials.vector(), MATERIALS.vector())
    explained(blocks, materials, found, atol=0.15)


def test_a_descent_with_the_materials_fixed_moves_the_light_alone():
    (data,), (light,) = truth(0)
    away = msgspec.structs.replace(light, log_sharpness=light.log_sharpness - 0.2)
    moved = msgspec.structs.replace(MATERIALS, roughness=MATERIALS.roughness + 0.03)
    problem = JointProblem([data], OPERATOR)
    start = evaluate(problem, Point(moved, [away]))
    found = descend(problem, start, Descent(5), fixed=np.ones(21, bool))
    np.testing.assert_array_equal(found.point.materials.vector(), moved.vector())
    assert found.loss < start.loss


def test_a_material_nobody_knows_is_found_in_the_known_lights():
    blocks, lights = truth(0, 1)
    earlier = written(
        blocks, Materials(*(getattr(MATERIALS, f)[:2] for f in MATERIALS.__struct_fields__)), lights, NAMES[:2], (0, 0), (False,) * 2
    )
    materials, _ = begun(earlier, blocks)
    assert abs(materials.roughness[2] - MATERIALS.roughness[2]) < 0.05
    np.testing.assert_allclose(materials.diffuse[2], MATERIALS.diffuse[2], atol=0.03)


def test_a_photo_new_to_a_light_gets_its_exposure_even_where_it_comes_first():
    blocks, lights = truth(0, photos=3)
    earlier = written(blocks, MATERIALS, lights)
    first, *others = blocks[0].photos
    relative = {photo: tuple(np.array(earlier.exposures[photo]) / earlier.exposures[others[0]][0]) for photo in others}
    factor = earlier.exposures[others[0]][0]
    lobes = {name: light.scaled(factor) for name, light in earlier.lights.items()}  # as it was while `first` was not there
    earlier = msgspec.structs.replace(earlier, exposures=relative, lights=lobes)
    light = with_exposures(Illumination(blocks[0], known_of(earlier, NAMES, blocks).lights[0], MATERIALS, OPERATOR))
    explained(blocks, MATERIALS, [light], atol=0.02)
    _, (light,) = begun(earlier, blocks)
    np.testing.assert_allclose(light.log_exposure, lights[0].log_exposure, atol=0.02)
    explained(blocks, MATERIALS, [light], atol=0.02)


def test_groups_that_a_new_photo_links_come_into_one_gauge():
    blocks, lights = zip(
        *(pair for pair in zip(*truth(0, shown=(0, 1)), strict=True)), *(pair for pair in zip(*truth(1, shown=(2,)), strict=True))
    )
    factor = np.array([3.0, 0.5, 1.5])
    apart = Materials(MATERIALS.diffuse.copy(), MATERIALS.specular.copy(), MATERIALS.roughness)
    apart.diffuse[2] *= factor
    apart.specular[2] *= factor
    own = [lights[0], msgspec.structs.replace(lights[1], weight=lights[1].weight / factor)]
    earlier = written(blocks, apart, own, component=(0, 0, 1))
    linking, _ = truth(2)
    materials, found = begun(earlier, [*blocks, *linking])
    np.testing.assert_allclose(materials.diffuse[2] / MATERIALS.diffuse[2], 1, rtol=0.1)
    explained(blocks, materials, found[:2], atol=0.15)


def test_a_light_that_is_no_longer_so_starts_anew_and_is_named(caplog):
    blocks, lights = truth(0, 1)
    turned = [msgspec.structs.replace(lights[0], axis=-lights[0].axis), lights[1]]
    with caplog.at_level(logging.WARNING):
        _, found = begun(written(blocks, MATERIALS, turned), blocks)
    assert "'room0' starts anew" in caplog.text and "room1" not in caplog.text
    explained(blocks, MATERIALS, found, atol=0.15)


def test_what_nothing_known_leads_to_starts_from_mean_radiances():
    known, lights = truth(0, shown=(0, 1))
    stranger, _ = truth(1, shown=(2,))
    earlier = written(
        known, Materials(*(getattr(MATERIALS, f)[:2] for f in MATERIALS.__struct_fields__)), lights, NAMES[:2], (0, 0), (False,) * 2
    )
    materials, found = begun(earlier, [*known, *stranger])
    np.testing.assert_array_equal(materials.vector()[:14], MATERIALS.vector()[:14])
    assert len(found[1]) == 1


def test_what_was_decided_of_a_specular_part_stays():
    blocks, lights = truth(0)
    start = from_earlier(written(blocks, MATERIALS, lights, lambertian=(True, False, False)), [*NAMES, "new"], "auto")
    assert start.decided.tolist() == [True, True, True, False] and start.lambertian.tolist() == [True, False, False, False]
    assert not from_earlier(written(blocks, MATERIALS, lights, lambertian=(True, False, False)), NAMES, "on").lambertian.any()


def test_nothing_known_in_a_block_leaves_its_light_unknown():
    blocks, lights = truth(0)
    earlier = written(blocks, MATERIALS, lights)
    none = msgspec.structs.replace(earlier, table=msgspec.structs.replace(earlier.table, materials={}, gauge=Gauge()))
    assert Propagation(JointProblem(blocks, OPERATOR), known_of(none, NAMES, blocks), BUNDLE).lights == [None]
