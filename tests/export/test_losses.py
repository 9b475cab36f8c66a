"""What other programs show of the exported materials, against slow integrals and cases whose answer is known."""

import numpy as np
import pytest
import torch

from factorlib.export import loss, viewers
from factorlib.export.viewers import MODELS, Angles, distribution
from factorlib.light.lobes import Lobes
from factorlib.reflection import reflection_operator
from factorlib.reflection.brdf import ggx, specular
from factorlib.results.materials import Reflectance

GREY = Reflectance((0.4, 0.3, 0.2), (0.3, 0.3, 0.3), 0.6)
COLOURED = Reflectance((0.2, 0.3, 0.4), (0.5, 0.2, 0.05), 0.4)
LAMBERTIAN = Reflectance((0.4, 0.3, 0.2), (0, 0, 0), 0.6)
BLACK = Reflectance((0, 0, 0), (0, 0, 0), 0.5)
MIRROR = Reflectance((0.1, 0.2, 0.3), (0.5, 0.4, 0.3), 0.0)
WITHOUT_FRESNEL = [name for name in MODELS if name not in ("glb_plain", "usd")]


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
        found = loss.in_sky(material, MODELS[name], np.array([no]))[0]
        np.testing.assert_allclose(found, brute_force(material, MODELS[name], no), rtol=5e-3)


def test_the_solved_model_is_the_operators():
    angles, _ = hemisphere(0.7, 40)
    mine = distribution(GREY.alpha, angles.nh) * viewers.separable(GREY.alpha, angles) * angles.ni
    alpha, ni, no, nh = (torch.tensor(a, dtype=torch.float64) for a in (GREY.alpha, angles.ni, angles.no, angles.nh))
    np.testing.assert_allclose(mine, specular(alpha, ni, no, nh), rtol=1e-9)
    np.testing.assert_allclose(distribution(GREY.alpha, angles.nh), ggx(alpha, nh), rtol=1e-9)
    sky = Lobes(np.array([[0.0, 0.0, 1.0]]), np.array([1e-6]), np.ones((1, 3)))
    normal, view = (torch.tensor([v], dtype=torch.float64) for v in ([0.0, 0.0, 1.0], [np.sqrt(1 - 0.49), 0.0, 0.7]))
    expected = reflection_operator("reference")(sky, GREY, normal, view)
    np.testing.assert_allclose(loss.in_sky(GREY, viewers.solved, np.array([0.7])), expected, rtol=2e-3)


@pytest.mark.parametrize("material", [LAMBERTIAN, BLACK], ids=["lambertian", "black"])
def test_without_specular_part_nothing_is_lost_but_by_viewers_that_add_one(material):
    found = loss.losses(material)
    assert all(found[name] == loss.Loss(0.0, 0.0) for name in WITHOUT_FRESNEL)
    assert np.isfinite(found["glb_plain"].mean) and found["glb_plain"].mean > 0.01
    assert 0 < found["usd"].mean < (0.005 if material is LAMBERTIAN else 2)


def test_usd_bends_what_has_both_parts_and_no_metals():
    assert loss.losses(Reflectance((0, 0, 0), (0.8, 0.6, 0.4), 0.7))["usd"] == loss.Loss(0.0, 0.0)
    assert loss.losses(GREY)["usd"].worst > 0.05


def test_a_grey_specular_part_has_no_fresnel_in_gltf_and_mirrors_lose_nothing_by_shadowing():
    assert loss.losses(GREY)["glb"].worst < 1e-5 and loss.losses(COLOURED)["glb"].worst > 0.02
    found = loss.losses(MIRROR)
    assert found["blender"].worst < 1e-4 and found["mtlx"].worst < 1e-3
    assert all(np.isfinite([each.mean, each.worst]).all() for each in found.values())


FRONT, ALONG = (Angles(*(np.array([v]) for v in (*[cosine] * 3, 1.0))) for cosine in (1.0, 0.7))


@pytest.mark.parametrize(
    "name, angles", [("blender", FRONT), ("glb", FRONT), ("glb_correlated", FRONT), ("usd", ALONG)]
)
def test_models_agree_where_shadowing_and_fresnel_are_nil(name, angles):
    """The mirror direction seen from the front; h = i = o, where there is no Fresnel."""
    found, expected = (model(COLOURED, angles) for model in (MODELS[name], viewers.solved))
    np.testing.assert_allclose(found.diffuse, expected.diffuse, rtol=1e-9)
    np.testing.assert_allclose(found.lobe, expected.lobe, rtol=1e-9)


def test_a_white_surface_that_gives_back_all_energy_is_white_in_the_sky():
    """Turquin's factor makes up for what single scattering loses: an albedo of 1 at every view, of F = 1."""
    white = Reflectance((0, 0, 0), (1.0, 1.0, 1.0), 0.7)
    for name in ("mtlx", "mtlx_standard_surface"):
        np.testing.assert_allclose(loss.in_sky(white, MODELS[name], np.array([0.3, 0.6, 1.0])), 1.0, rtol=5e-3)
