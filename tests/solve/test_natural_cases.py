"""Lights unlike most: the solve with a prior on natural light says what the photographs say, not what is usual."""

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, factor_between, random_light
from factorlib.light.prior import read_light_prior
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.lattice import Lattice
from factorlib.solve.natural import Natural, naturally

FEW = 120  # lobes of a lattice, so that tests are quick
OPERATOR, PRIOR = reflection_operator("network"), read_light_prior()


def light_of(axes, sharpness, weights) -> Light:
    """Lobes at `axes`, of those sharpnesses and weights [p, 3]."""
    axes = np.asarray(axes, float)
    light = random_light(np.random.default_rng(0), 1)
    sharpness = np.broadcast_to(np.asarray(sharpness, float), len(axes))
    weight = np.broadcast_to(np.asarray(weights, float), (len(axes), 3))
    return msgspec.structs.replace(
        light, axis=axes / np.linalg.norm(axes, axis=1, keepdims=True), log_sharpness=np.log(sharpness), weight=np.array(weight)
    )


def found_in(lights: list[Light], shown=(0, 1, 2), lambertian=(False, False, False), materials: Materials = MATERIALS) -> Natural:
    """The solve of noisy spheres of `shown` materials, one photo a light."""
    blocks = []
    for k, light in enumerate(lights):
        clean = block(f"room{k}", light, materials, list(shown), OPERATOR, size=14, seed=k)
        noise = 0.3 * np.random.default_rng(k).normal(size=clean.radiance.shape) / clean.precision
        blocks.append(msgspec.structs.replace(clean, radiance=np.maximum(clean.radiance + noise, 0.0)))
    start = Materials(np.full((3, 3), 0.3), np.where(np.array(lambertian)[:, None], 0.0, np.full((3, 3), 0.1)), np.full(3, 0.4))
    return naturally(JointProblem(blocks, OPERATOR, Loss()), Point(start, lights), PRIOR, np.array(lambertian), lobes=FEW)


def constant(colour=(1.0, 1.0, 1.0)) -> Light:
    """The same radiance from everywhere."""
    return light_of([[0, 0, 1.0]], 1e-4, [colour])


def contrast(found: Natural) -> float:
    """Standard deviation over the lattice of the log radiance, the mean of the channels, in the first light."""
    return float(found.log_radiance[0].mean(0).std())


def test_a_constant_light_stays_nearly_constant():
    assert contrast(found_in([constant()])) < 0.3  # natural light has 1.2


def test_a_light_of_one_colour():
    """A channel without light says nothing, and spoils nothing."""
    rng, lights = np.random.default_rng(1), []
    for _ in range(2):
        lights.append(light_of(rng.normal(size=(15, 3)), 12.0, rng.exponential(size=(15, 1)) * [1.0, 0.02, 0.005]))
    found = found_in(lights).point.materials
    assert np.abs(found.roughness - MATERIALS.roughness).max() < 0.15
    whole = [(m.diffuse + m.specular)[:, 0] for m in (found, MATERIALS)]
    assert np.allclose(whole[0] / whole[0].mean(), whole[1] / whole[1].mean(), rtol=0.15)


def test_lamps_at_night_are_found_where_they_are():
    axes = np.array([[0.6, -0.5, -0.6], [-0.7, -0.3, -0.6], [0.1, 0.6, -0.8]])
    lamps = light_of(np.vstack([axes, [0, 0, 1.0]]), [60, 60, 60, 1e-4], np.array([8.0, 6.0, 7.0, 0.02])[:, None] * np.ones(3))
    found, lattice = found_in([lamps]), Lattice.of(FEW)
    radiance = np.exp(found.log_radiance[0]).mean(0)
    near = np.degrees(np.arccos(np.clip(lattice.axis @ (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T, -1, 1)))
    assert radiance[near.min(1) < 25].sum() > 0.6 * radiance.sum()
    for lamp in near.T:
        around = lamp < 30
        assert lamp[around][radiance[around].argmax()] < 19  # cells are 18° apart


def test_all_surfaces_lambertian():
    lambertian = Materials(MATERIALS.diffuse, np.zeros((3, 3)), MATERIALS.roughness)
    lattice = Lattice.of(FEW)
    lights = [light_of(lattice.axis, lattice.sharpness, np.exp(np.sin(2 * lattice.axis[:, k : k + 1]))) for k in range(2)]
    found = found_in(lights, lambertian=(True,) * 3, materials=lambertian).point.materials
    assert np.abs(found.diffuse * factor_between(found, lambertian) / lambertian.diffuse - 1).max() < 0.05 and not found.specular.any()


@pytest.mark.parametrize("shown", [(0,), (2,)])
def test_one_photo_of_one_material(shown):
    lattice = Lattice.of(FEW)
    light = light_of(lattice.axis, lattice.sharpness, np.exp(np.sin(3 * lattice.axis[:, :1] + 1) * 1.5))
    found = found_in([light], shown)
    parts = [found.point.materials.vector(), *found.log_radiance]
    assert all(np.isfinite(part).all() for part in parts) and contrast(found) < 3
