"""The ball renderer against closed forms and against plain quadrature over every texel of the map."""

import numpy as np
import pytest

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.evaluate.ball import VIEW, diffuse_lobe, glossy_lobe, octahedral_light
from factorlib.geometry.sphere import ball_normals
from factorlib.results.materials import Reflectance
from tests.integral import reflected

NORMALS, INSIDE = ball_normals(16)


def lobe_map(sharpness, height=128):
    axis = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])
    value = np.exp(sharpness * (lat_long_directions(height, 2 * height) @ axis - 1))
    return value[..., None] * [1.0, 2.0, 3.0] + 0.1


def plain_quadrature(radiance, normals, diffuse, specular, roughness=0.5):
    """Of every texel of the map."""
    height, width = radiance.shape[:2]
    light = radiance * lat_long_solid_angles(height, width)[:, None, None]
    material, views = Reflectance((diffuse,) * 3, (specular,) * 3, roughness), np.tile(VIEW, (len(normals), 1))
    incoming = lat_long_directions(height, width).reshape(-1, 3)
    return reflected(material, normals, views, incoming, light.reshape(-1, 3))


@pytest.mark.parametrize("sharpness", [5, 60])
@pytest.mark.parametrize("roughness", [0.25, 0.9])
def test_the_glossy_ball_is_the_plain_quadrature(sharpness, roughness):
    radiance, some = lobe_map(sharpness), NORMALS[::9]
    expected = plain_quadrature(radiance, some, 0.0, 1.0, roughness)
    found = glossy_lobe(some, roughness)(octahedral_light(radiance))
    assert np.median(np.abs(found / expected - 1)) < 0.01
    assert np.abs(found - expected).max() < 0.03 * expected.max()


def test_the_matte_ball_is_the_plain_quadrature():
    radiance = lobe_map(20)
    expected = plain_quadrature(radiance, NORMALS, 1.0, 0.0)
    assert diffuse_lobe(NORMALS)(octahedral_light(radiance)) == pytest.approx(expected, rel=5e-3)


def test_the_viewer_sees_light_from_the_right_on_the_right():
    radiance = np.zeros((16, 32, 3))
    radiance[6:10, 7:9] = 1.0  # +x: a quarter of the width from the left edge
    picture = np.zeros(INSIDE.shape)
    picture[INSIDE] = diffuse_lobe(NORMALS)(octahedral_light(radiance))[:, 0]
    assert picture[:, 8:].sum() > 20 * picture[:, :8].sum()
