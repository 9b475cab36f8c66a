"""Light at a finite distance, against sums over a sphere of light about the middle."""

import numpy as np
import pytest

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.distance import met_from, places_of

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


def test_highlights_mirror_what_lies_along_the_ray(points):
    place, normal, view = points
    _, oz, _ = met_from(place, normal, view, AXES, CURVATURE)
    to = AXES - CURVATURE * place[:, None]
    expected = np.einsum("npk,nk->np", to / np.linalg.norm(to, axis=2, keepdims=True), view)
    np.testing.assert_allclose(oz, expected, atol=1e-12)


def test_a_constant_light_stays_constant_and_a_far_one_is_that_of_the_map(points):
    place, normal, view = points
    np.testing.assert_allclose(met_from(place, normal, view, AXES, 0.3)[2].mean(1), 1, rtol=0.01)
    nz, oz, larger = met_from(place, normal, view, AXES, 0.0)
    np.testing.assert_allclose(nz, np.clip(normal @ AXES.T, -1, 1))
    np.testing.assert_allclose(oz, np.clip(view @ AXES.T, -1, 1))
    assert (larger == 1).all()


def test_a_point_at_the_light_is_taken_for_one_halfway(points):
    place, normal, view = points
    near = place / np.linalg.norm(place, axis=1, keepdims=True)
    for a, b in zip(met_from(near, normal, view, AXES, 1.0), met_from(near, normal, view, AXES, 0.5), strict=True):
        np.testing.assert_allclose(a, b)


def test_places_are_about_the_middle_and_know_no_unit():
    rng = np.random.default_rng(1)
    points, weight = rng.normal(size=(50, 3)) * 0.3 + [0.2, -0.1, 4], rng.random(50)
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    found = places_of(view, points[:, 2], weight)
    np.testing.assert_allclose(weight @ found, 0, atol=1e-12)
    assert np.average((found**2).sum(1), weights=weight) == pytest.approx(1)
    np.testing.assert_allclose(places_of(view, 1000 * points[:, 2], weight), found)
    between, scale = points - points[0], np.linalg.norm(points[1] - points[0]) / np.linalg.norm(found[1] - found[0])
    np.testing.assert_allclose(scale * (found - found[0]), between, atol=1e-12)
    assert places_of(view[:0], np.zeros(0), np.zeros(0)).shape == (0, 3)
