"""Lights unlike most: a fit with a prior on natural light says what the photographs say, not what is usual."""

import numpy as np
import pytest

from factorlib.model.lights import Light, even_cells
from factorlib.model.materials import Materials
from factorlib.solve.fit import Fit, Schedule, fitted
from studies.scenes.problems import MATERIALS, factor_between
from tests.solve.made import FEW, FREE, PRIOR, START, begun, light_of, on_even_cells, spheres

WHOLE = Schedule(4, (14, 10))


def found_in(lights: list[Light], shown=(0, 1, 2), materials: Materials = MATERIALS, free=FREE, start=START) -> Fit:
    """The fit of noisy spheres of `shown` materials, one photo a light."""
    problem = spheres(lights, materials, shown)
    return fitted(problem, begun(problem, FEW, start), PRIOR, WHOLE, free)


def contrast(light: Light) -> float:
    """Standard deviation over the cells of the log radiance, the mean of the channels."""
    return float(light.log_radiance.mean(0).std())


def test_a_constant_light_stays_nearly_constant():
    constant = light_of([[0, 0, 1.0]], 1e-4, [[1.0, 1.0, 1.0]])
    assert contrast(found_in([constant]).point.lights[0]) < 0.3  # natural light has 1.2


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
    lamps = light_of(
        np.vstack([axes, [0, 0, 1.0]]), [60, 60, 60, 1e-4], np.array([8.0, 6.0, 7.0, 0.02])[:, None] * np.ones(3)
    )
    light = found_in([lamps]).point.lights[0]
    radiance = np.exp(light.log_radiance).mean(0)
    near = np.degrees(np.arccos(np.clip(light.axis @ (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T, -1, 1)))
    assert radiance[near.min(1) < 25].sum() > 0.6 * radiance.sum()
    for lamp in near.T:
        around = lamp < 30
        assert lamp[around][radiance[around].argmax()] < 19  # cells are 18° apart


def test_all_surfaces_lambertian():
    """Where specular parts are known to be nil, they stay so."""
    lambertian, axis = Materials(MATERIALS.diffuse, np.zeros((3, 3)), MATERIALS.roughness), even_cells(FEW).axis
    lights = [on_even_cells(np.tile(np.sin(2 * axis[:, k]), (3, 1))) for k in range(2)]
    free = FREE & (np.arange(7) < 3)
    start = Materials(START.diffuse, np.zeros((3, 3)), START.roughness)
    found = found_in(lights, materials=lambertian, free=free, start=start).point.materials
    assert (
        np.abs(found.diffuse * factor_between(found, lambertian) / lambertian.diffuse - 1).max() < 0.05
        and not found.specular.any()
    )


@pytest.mark.parametrize("shown", [(0,), (2,)])
def test_one_photo_of_one_material(shown):
    light = on_even_cells(np.tile(1.5 * np.sin(3 * even_cells(FEW).axis[:, 0] + 1), (3, 1)))
    found = found_in([light], shown).point
    assert (
        all(np.isfinite(part).all() for part in (found.materials.vector(), found.lights[0].weight))
        and contrast(found.lights[0]) < 3
    )
