"""Light at a finite distance, against sums over a sphere of light about the middle."""

import numpy as np
import pytest

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.distance import met_from

AXES, CURVATURE = fibonacci_sphere(4000), 0.2
SOLID_ANGLE = 4 * np.pi / len(AXES)


def smooth_light(z):
    """Radiance of the sphere of light, by the direction from its middle."""
    return 1 + 0.9 * z[..., 0] * z[..., 1] + 2 * np.exp(4 * (z @ np.array([0.6, 0, -0.8]) - 1))


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(0)
    place, normal, view = rng.normal(size=(3, 40, 3))
    place *= (rng.uniform(0, 2, 40) / np.linalg.norm(place, axis=1))[:, None]
    return place, *(v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, view))


def irradiance(cosine, larger):
    return np.maximum(cosine, 0) * larger @ smooth_light(AXES) * SOLID_ANGLE


def test_irradiance_beside_the_middle_is_that_of_rays_to_the_sphere_of_light(points):
    place, normal, view = points
    nz, _, larger = met_from(place, normal, view, AXES, CURVATURE)
    X = CURVATURE * place
    along = X @ AXES.T  # of rays in directions AXES from X, t is where they meet the unit sphere
    t = -along + np.sqrt(along**2 + 1 - (X**2).sum(1)[:, None])
    met = X[:, None] + t[..., None] * AXES
    traced = (np.maximum(normal @ AXES.T, 0) * smooth_light(met)).sum(1) * SOLID_ANGLE
    np.testing.assert_allclose(irradiance(nz, larger), traced, rtol=0.01)
    assert np.abs(irradiance(normal @ AXES.T, 1.0) / traced - 1).max() > 0.1
