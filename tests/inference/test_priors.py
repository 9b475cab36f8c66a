"""The prior on materials: what classes it knows, what they cost, and how they are fitted."""

import numpy as np
import pytest

from factorlib.inference.materials import Materials
from factorlib.inference.priors import (
    BRIGHTNESS_DEVIATION,
    DIFFUSE_DEVIATION,
    MEDIAN_BRIGHTNESS,
    MaterialPrior,
    Mixture,
    likeliest_class,
    material_unknowns,
    shipped_classes,
)
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made_lights import photographed

PLASTIC, GOLD, FELT = ([0.03] * 3, 0.2), ([0.3, 0.21, 0.09], 0.2), ([0.22] * 3, 0.9)


def test_the_brightest_material_holds_the_gauge():
    problem, _ = photographed(6, 1, cells=50, size=10)
    lambertian = Materials(MATERIALS.diffuse, np.zeros((3, 3)), MATERIALS.roughness)
    matt, theta = MaterialPrior(lambertian, problem.blocks), material_unknowns(lambertian)
    brightest, level = int(MATERIALS.diffuse.sum(1).argmax()), float(MATERIALS.diffuse.sum(1).max() / 3)
    for factor in (1.0, 2.0):
        shifted = theta.copy()
        shifted[brightest, :3] += np.log(factor)
        expected = (np.log(factor * level / MEDIAN_BRIGHTNESS) / BRIGHTNESS_DEVIATION) ** 2 + 3 * (
            np.log(factor) / DIFFUSE_DEVIATION
        ) ** 2
        assert matt.evaluate(shifted).value == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("seed", range(2))
def test_the_gradient_is_the_finite_difference_of_the_value(seed):
    problem, rng = photographed(6, 1, cells=50, size=10)[0], np.random.default_rng(seed)
    prior, theta = MaterialPrior(MATERIALS, problem.blocks), material_unknowns(MATERIALS)
    at = theta + np.array([0.3] * 6 + [0.1]) * rng.normal(size=theta.shape)
    change = rng.normal(size=theta.shape) * 1e-4
    difference = (prior.evaluate(at + change).value - prior.evaluate(at - change).value) / 4
    assert prior.evaluate(at).gradient @ change.reshape(-1) == pytest.approx(difference, rel=1e-4)
    assert np.linalg.eigvalsh(prior.evaluate(at).hessian).min() > 0


def test_the_density_is_one_altogether():
    """Over the level of k_s, its tint and the roughness: the sum on a grid."""
    level, roughness, tint = np.arange(-9, 4, 0.8), np.arange(-2.5, 4, 0.3), np.arange(-1.6, 1.61, 0.2)
    mixture, across = Mixture(shipped_classes().classes), np.array([[1, -1, 0], [1, 1, -2]]) / np.sqrt([[2], [6]])
    grid = np.array(np.meshgrid(level, tint, tint, roughness)).reshape(4, -1).T
    points = np.column_stack([grid[:, :1] + grid[:, 1:3] @ across, grid[:, 3]])
    total = sum(np.exp(-mixture.evaluate(point)[0] / 2) for point in points)
    assert total * 0.8 * 0.3 * 0.2**2 / (2 * np.pi) ** 2 == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("material, name", [(PLASTIC, "dielectric"), (GOLD, "metal"), (FELT, "fabric")])
def test_materials_are_of_the_class_that_they_look_like(material, name):
    found, probability = likeliest_class(np.array(material[0]), material[1], 0.05, 0.02)
    assert found == name and probability > 0.8


def test_gloss_ten_times_too_strong_at_roughness_1_is_not_expected():
    """It is possible, for fabrics look so, but evidence has to pay for it; and a smooth surface with a strong highlight is metal or nothing."""

    def cost(specular, roughness):
        materials = Materials(np.full((1, 3), 0.3), np.array([specular]), np.array([roughness]))
        return MaterialPrior(materials, []).evaluate(material_unknowns(materials)).value

    assert cost([0.3] * 3, 1.0) > cost(*PLASTIC) + 6
    assert cost([0.03] * 3, 1.0) > cost(*PLASTIC) + 6
    assert cost(*PLASTIC) + 3 < cost([0.3] * 3, 0.2) < cost([0.3] * 3, 1.0)
