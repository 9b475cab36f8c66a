"""The search for another roughness, the lights as they are."""

import msgspec
import numpy as np
import pytest

from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.roughness import materials_of_best_roughness, reflectances
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("network")


def problem(materials: int, lights: int):
    """Blocks, materials and lights that explain them."""
    rng = np.random.default_rng(3)
    truth = Materials(MATERIALS.diffuse[:materials], MATERIALS.specular[:materials], MATERIALS.roughness[:materials])
    found = [random_light(rng, 5) for _ in range(lights)]
    blocks = [block(f"light_{k}", light, truth, range(materials), OPERATOR) for k, light in enumerate(found)]
    scaled = [
        Light(li.axis, li.log_sharpness, li.weight / b.unit, li.log_exposure)
        for b, li in zip(blocks, found, strict=True)
    ]
    return blocks, truth, scaled


def searched(blocks, materials, lights):
    return materials_of_best_roughness(JointProblem(blocks, OPERATOR), Point(materials, lights))


def test_a_roughness_far_off_is_found_again():
    blocks, truth, lights = problem(materials=3, lights=2)
    wrong = Materials(truth.diffuse * 1.3, truth.specular * 0.5, np.array([0.95, *truth.roughness[1:]]))
    found = searched(blocks, wrong, lights)
    assert abs(found.roughness[0] - truth.roughness[0]) < 0.1  # the grid's own spacing
    np.testing.assert_array_equal(found.roughness[1:], wrong.roughness[1:])  # what is right stays


def test_a_material_that_nothing_shows_stays():
    blocks, truth, lights = problem(materials=2, lights=2)
    more = Materials(*(np.concatenate([v, v[:1]]) for v in (truth.diffuse, truth.specular, truth.roughness)))
    found = searched(blocks, more, lights)
    np.testing.assert_array_equal(found.vector()[14:], more.vector()[14:])


def test_reflectances_are_those_that_made_the_radiance():
    random = np.random.default_rng(0)
    diffuse, specular = random.uniform(0.1, 1, (2, 50, 3))
    kd, ks = np.array([0.3, 0.2, 0.1]), np.array([0.05, 0.1, 0.2])
    loss, found_kd, found_ks = reflectances(diffuse, specular, kd * diffuse + ks * specular, np.ones((50, 3)))
    assert loss == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose([found_kd, found_ks], [kd, ks], rtol=1e-6)


def test_clipped_channels_do_not_vote():
    blocks, truth, lights = problem(materials=2, lights=2)
    clipped = [
        msgspec.structs.replace(b, clipped=b.clipped | (np.arange(len(b)) % 2 == 0)[:, None], radiance=np.where((np.arange(len(b)) % 2 == 0)[:, None], 0.01, b.radiance))
        for b in blocks
    ]  # fmt: skip
    wrong = Materials(truth.diffuse, truth.specular, np.array([1.0, truth.roughness[1]]))
    found = searched(clipped, wrong, lights)
    assert abs(found.roughness[0] - truth.roughness[0]) < 0.1
