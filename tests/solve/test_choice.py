"""Specular parts are kept where held-out observations need them."""

import msgspec
import numpy as np

from factorlib.reflection import reflection_operator
from factorlib.solve import choice
from factorlib.solve.bundle import solve
from factorlib.solve.descent import descend
from factorlib.solve.options import Bundle
from factorlib.solve.problem import mirror_cells
from factorlib.solve.unknowns import Materials
from factorlib.stage import serial_map
from tests.solve.problems import block, random_light

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
    bundle = Bundle(lobes=16, insert=6, rounds=3, iterations=12, polish=10, **options)
    return solve(rooms(materials, shown), 3, OPERATOR, bundle, serial_map, lambda event: None)


def test_matte_materials_lose_their_specular_part_and_glossy_ones_keep_it():
    joint = chosen(MIXED, [0, 1, 2])
    assert joint.matte.tolist() == [True, True, False]
    assert (joint.solution.materials.specular[:2] == 0).all()
    assert joint.specular[2].held_out_loss_without > 1.05 * joint.specular[2].held_out_loss_with


def test_few_lights_that_show_a_material_decide_as_all_do(monkeypatch):
    monkeypatch.setattr(choice, "LIGHTS", 1)
    joint = chosen(MIXED, [0, 1, 2])
    assert joint.matte.tolist() == [True, True, False]
    assert (joint.solution.materials.specular[:2] == 0).all()
    assert len(joint.solution.lights) == 2


def test_a_matte_scene_ends_without_specular_and_with_few_lobes():
    matte, glossy = chosen(MIXED, [0, 1]), chosen(MIXED, [0, 1, 2])
    assert matte.matte[:2].all()
    assert sum(map(len, matte.solution.lights)) <= 1.2 * sum(map(len, glossy.solution.lights))


def test_nothing_is_chosen_where_it_is_not_asked_for():
    joint = chosen(MIXED, [0, 1, 2], specular="on")
    assert not joint.matte.any() and joint.specular == []


def test_what_shines_more_than_it_scatters_is_not_tried():
    glossy = Materials(MIXED.diffuse / np.array([[1], [1], [5]]), MIXED.specular, MIXED.roughness)
    joint = chosen(glossy, [0, 1, 2])
    assert not joint.matte[2] and joint.specular[2].held_out_loss_without is None


def test_a_descent_that_spoils_what_is_held_out_decides_nothing(monkeypatch):
    """Out of sight of the fit, a lobe may grow where held-out observations alone mirror it: here it does where all have specular parts."""

    def spoiled(blocks, start, *arguments, held, **options):
        at = descend(blocks, start, *arguments, held=held, **options)
        factor = 1 if held.any() else 3
        return msgspec.structs.replace(at, lights=[msgspec.structs.replace(light, weight=factor * light.weight) for light in at.lights])

    monkeypatch.setattr(choice, "descend", spoiled)
    assert chosen(MIXED, [2]).specular[2].kept
