"""The ball renderer against closed forms and against plain quadrature over every texel of the map."""

import numpy as np
import pytest

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.evaluate.ball import (
    VIEW,
    diffuse_ball,
    glossy_ball,
    light_of_lat_long,
)
from factorlib.geometry.sphere import ball_normals

NORMALS, INSIDE = ball_normals(16)


def lobe_map(sharpness, height=128):
    axis = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])
    value = np.exp(sharpness * (lat_long_directions(height, 2 * height) @ axis - 1))
    return value[..., None] * [1.0, 2.0, 3.0] + 0.1


def plain_quadrature(radiance, normals, roughness):
    """Σ over texels of L · D G / (4 n·o) · Ω."""
    height, width = radiance.shape[:2]
    incoming = lat_long_directions(height, width).reshape(-1, 3)
    area = np.repeat(lat_long_solid_angles(height, width), width)
    alpha2, found = roughness**4, []

    def g1(c):
        return 2 * c / (c + np.sqrt(alpha2 + (1 - alpha2) * c * c))

    half = (incoming + VIEW) / np.linalg.norm(incoming + VIEW, axis=-1, keepdims=True)
    for n in normals:
        ci, co, ch = np.maximum(incoming @ n, 0), n[2], half @ n
        d = alpha2 / (np.pi * (ch**2 * (alpha2 - 1) + 1) ** 2)
        found.append((d * g1(ci + 1e-12) * g1(co) / (4 * co) * (ci > 0) * area) @ radiance.reshape(-1, 3))
    return np.array(found)


@pytest.mark.parametrize("sharpness", [5, 60])
@pytest.mark.parametrize("roughness", [0.25, 0.4, 0.5, 0.9])
def test_the_glossy_ball_is_the_plain_quadrature(sharpness, roughness):
    radiance, some = lobe_map(sharpness), NORMALS[::9]
    expected = plain_quadrature(radiance, some, roughness)
    found = glossy_ball(light_of_lat_long(radiance), some, roughness)
    assert np.median(np.abs(found / expected - 1)) < 0.01
    assert np.abs(found - expected).max() < 0.03 * expected.max()


def test_the_matte_ball_is_the_plain_quadrature():
    radiance, incoming = lobe_map(20), lat_long_directions(128, 256).reshape(-1, 3)
    weight = np.maximum(NORMALS @ incoming.T, 0) * np.repeat(lat_long_solid_angles(128, 256), 256)
    expected = weight @ radiance.reshape(-1, 3) / np.pi
    assert diffuse_ball(light_of_lat_long(radiance), NORMALS) == pytest.approx(expected, rel=5e-3)


def test_the_viewer_sees_light_from_the_right_on_the_right():
    radiance = np.zeros((16, 32, 3))
    radiance[6:10, 7:9] = 1.0  # +x: a quarter of the width from the left edge
    picture = np.zeros(INSIDE.shape)
    picture[INSIDE] = diffuse_ball(light_of_lat_long(radiance), NORMALS)[:, 0]
    assert picture[:, 8:].sum() > 20 * picture[:, :8].sum()
