"""Specular parts are kept where held-out observations need them."""

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import mirror_cells
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes import specular
from factorlib.solve.few_lobes.descent import descend
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.solve import few_lobes
from studies.scenes.problems import block, random_light

OPERATOR = reflection_operator("network")
MIXED = Materials(
    diffuse=np.array([[0.6, 0.3, 0.2], [0.2, 0.3, 0.4], [0.35, 0.3, 0.4]]),
    specular=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.2, 0.2]]),
    roughness=np.array([0.5, 0.5, 0.35]),
)


def rooms(materials, shown, noise=0.3):
    rng, blocks = np.random.default_rng(11), []
    for k in range(2):
        data = block(f"room{k}", random_light(rng, 4), materials, shown, OPERATOR, size=20, seed=k)
        radiance = np.maximum(data.radiance + noise * rng.normal(size=data.radiance.shape) / data.precision, 0)
        _, cell = np.unique(mirror_cells(data.normal, data.view, 0.2), return_inverse=True)
        held_out = (rng.random(cell.max() + 1) < 0.15)[cell.reshape(-1)]
        blocks.append(msgspec.structs.replace(data, radiance=radiance, held_out=held_out))
    return blocks


def chosen(materials, shown, **options):
    options = FewLobes(lobes=16, insert=6, polish=10, **{"rounds": 3, "iterations": 12} | options)
    return few_lobes(JointProblem(rooms(materials, shown), OPERATOR), 3, Run(options))


@pytest.fixture(scope="module")
def mixed():
    return chosen(MIXED, [0, 1, 2])


def test_lambertian_materials_lose_their_specular_part_and_glossy_ones_keep_it(mixed):
    found = mixed
    assert found.lambertian.tolist() == [True, True, False]
    assert (found.point.materials.specular[:2] == 0).all()
    assert found.specular[2].held_out_loss_without > 1.05 * found.specular[2].held_out_loss_with


def test_few_lights_that_show_a_material_decide_as_all_do(monkeypatch):
    monkeypatch.setattr(specular, "LIGHTS", 1)
    found = chosen(MIXED, [0, 1, 2])
    assert found.lambertian.tolist() == [True, True, False]
    assert (found.point.materials.specular[:2] == 0).all()
    assert len(found.point.lights) == 2


def test_a_lambertian_scene_ends_without_specular_and_with_few_lobes(mixed):
    lambertian, glossy = chosen(MIXED, [0, 1]), mixed
    assert lambertian.lambertian[:2].all()
    assert sum(map(len, lambertian.point.lights)) <= 1.2 * sum(map(len, glossy.point.lights))


@pytest.mark.parametrize("specular", ["on", "off"])
def test_nothing_is_chosen_where_it_is_not_asked_for(specular):
    found = chosen(MIXED, [0, 1, 2], specular=specular, rounds=1)
    assert found.lambertian.all() == found.lambertian.any() == (specular == "off") and found.specular == []
    assert (found.point.materials.specular.any() == 0) == (specular == "off")


def test_what_shines_more_than_it_scatters_is_not_tried():
    glossy = Materials(MIXED.diffuse / np.array([[1], [1], [5]]), MIXED.specular, MIXED.roughness)
    found = chosen(glossy, [0, 1, 2])
    assert not found.lambertian[2] and found.specular[2].held_out_loss_without is None


def test_a_descent_that_spoils_what_is_held_out_decides_nothing(monkeypatch):
    """Out of sight of the fit, a lobe may grow where held-out observations alone mirror it: here it does where all have specular parts."""

    def spoiled(problem, start, *arguments, fixed, **options):
        at = descend(problem, start, *arguments, fixed=fixed, **options)
        factor = 1 if fixed.any() else 3
        lights = [msgspec.structs.replace(light, weight=factor * light.weight) for light in at.point.lights]
        return msgspec.structs.replace(at, point=Point(at.point.materials, lights))

    monkeypatch.setattr(specular, "descend", spoiled)
    assert chosen(MIXED, [2]).specular[2].kept


def test_a_material_is_judged_by_its_held_out_observations_but_may_not_harm_the_others(monkeypatch):
    problem, truth = JointProblem(rooms(MIXED, [0, 1, 2], noise=0.0), OPERATOR), scaled_truth()
    rows = truth.materials.rows()
    rows[0, :3] *= 1.2
    brighter = [msgspec.structs.replace(light, weight=1.01 * light.weight) for light in truth.lights]
    pair = Point(Materials.of_vector(rows.reshape(-1)), truth.lights), Point(truth.materials, brighter)
    monkeypatch.setattr(specular, "HARM", 1e9)
    assert specular.compare(problem, *pair, 0).kept and not specular.compare(problem, *pair, 1).kept
    monkeypatch.setattr(specular, "HARM", 0.0)
    assert specular.compare(problem, *pair, 1).kept
    fitted = [np.where(b.held_out[:, None], b.radiance, 7.0) for b in problem.blocks]
    blocks = [msgspec.structs.replace(b, radiance=r) for b, r in zip(problem.blocks, fitted, strict=True)]
    other = msgspec.structs.replace(problem, blocks=blocks)
    assert specular.compare(other, *pair, 0) == specular.compare(problem, *pair, 0)


def scaled_truth():
    """The point that `rooms` shows, in the units of its blocks."""
    rng, blocks = np.random.default_rng(11), rooms(MIXED, [0, 1, 2], noise=0.0)
    lights = []
    for k, data in enumerate(blocks):
        light = random_light(rng, 4)
        block(f"room{k}", light, MIXED, [0, 1, 2], OPERATOR, size=20, seed=k)
        rng.normal(size=data.radiance.shape), rng.random(len(np.unique(mirror_cells(data.normal, data.view, 0.2))))
        lights.append(msgspec.structs.replace(light, weight=light.weight / data.unit))
    return Point(MIXED, lights)
