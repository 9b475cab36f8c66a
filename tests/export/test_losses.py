"""What other programs show of the exported materials, against slow integrals and cases whose answer is known."""

import numpy as np
import pytest
import torch

from factorlib.export import other_renderers
from factorlib.export.other_renderers import MODELS, Angles, distribution
from factorlib.light.lobes import Lobes
from factorlib.reflection import reflection_operator
from factorlib.reflection.brdf import ggx, specular
from factorlib.results.materials import Reflectance

GREY = Reflectance((0.4, 0.3, 0.2), (0.3, 0.3, 0.3), 0.6)
COLOURED = Reflectance((0.2, 0.3, 0.4), (0.5, 0.2, 0.05), 0.4)


def hemisphere(no: float, count: int = 600) -> tuple[Angles, float]:
    """Angles of directions spread evenly over half the hemisphere, and their solid angle, doubled."""
    ni, phi = (a.reshape(-1) for a in np.meshgrid(*2 * [(np.arange(count) + 0.5) / count]))
    io = ni * no + np.sqrt((1 - ni**2) * (1 - no**2)) * np.cos(np.pi * phi)
    oh = np.sqrt((1 + io) / 2)
    return Angles(ni, np.full_like(ni, no), (ni + no) / (2 * oh), oh), 2 * np.pi / count**2


def brute_force(material: Reflectance, model, no: float) -> np.ndarray:
    """∫ f n·i di by a plain sum."""
    angles, area = hemisphere(no)
    parts = model(material, angles)
    brdf = parts.diffuse + distribution(material.alpha, angles.nh)[:, None] * parts.lobe
    return (brdf * angles.ni[:, None]).sum(axis=0) * area


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("material", [GREY, COLOURED], ids=["grey", "coloured"])
def test_radiance_in_the_sky_is_the_integral_of_the_brdf(name, material):
    for no in (0.3, 0.9):
        found = other_renderers.in_sky(material, MODELS[name], np.array([no]))[0]
        np.testing.assert_allclose(found, brute_force(material, MODELS[name], no), rtol=5e-3)


def test_the_solved_model_is_the_operators():
    angles, _ = hemisphere(0.7, 40)
    mine = distribution(GREY.alpha, angles.nh) * other_renderers.separable(GREY.alpha, angles) * angles.ni
    alpha, ni, no, nh = (torch.tensor(a, dtype=torch.float64) for a in (GREY.alpha, angles.ni, angles.no, angles.nh))
    np.testing.assert_allclose(mine, specular(alpha, ni, no, nh), rtol=1e-9)
    np.testing.assert_allclose(distribution(GREY.alpha, angles.nh), ggx(alpha, nh), rtol=1e-9)
    sky = Lobes(np.array([[0.0, 0.0, 1.0]]), np.array([1e-6]), np.ones((1, 3)))
    normal, view = (torch.tensor([v], dtype=torch.float64) for v in ([0.0, 0.0, 1.0], [np.sqrt(1 - 0.49), 0.0, 0.7]))
    expected = reflection_operator("reference")(sky, GREY, normal, view)
    np.testing.assert_allclose(
        other_renderers.in_sky(GREY, other_renderers.solved, np.array([0.7])), expected, rtol=2e-3
    )
