"""Lobes: their integral and table, what is seen of them past other surfaces, and lobes at a finite distance."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.distance import finite_distance_cosines
from factorlib.light.lobes import Lobes, lobe_integral, no_lobes
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, visible_share
from factorlib.results.lobe_table import read_lobes, write_lobes


def some_lobes(count: int = 6, seed: int = 0) -> Lobes:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    return Lobes(
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        np.geomspace(0.1, 5000, count),
        rng.uniform(0.1, 2, (count, 3)),
    )


@pytest.mark.parametrize("sharpness", [1e-6, 5e-4, 2e-3, 0.1, 3.0, 500.0])
def test_integral_is_the_quadrature_over_the_cosine(sharpness):
    expected = 2 * np.pi * quad(lambda t: np.exp(sharpness * (t - 1)), -1, 1)[0]
    assert lobe_integral(sharpness) == pytest.approx(expected, rel=1e-9)


def test_table_round_trip_is_exact_and_byte_equal(tmp_path):
    lights = {"b": some_lobes(3, 1), "dark": no_lobes(), "a": some_lobes(4, 2)}
    write_lobes(tmp_path / "1.parquet", lights)
    write_lobes(tmp_path / "2.parquet", dict(reversed(lights.items())))
    assert (tmp_path / "1.parquet").read_bytes() == (tmp_path / "2.parquet").read_bytes()
    found = read_lobes(tmp_path / "1.parquet")
    assert set(found) == set(lights)
    for name, lobes in lights.items():
        for field in ("axis", "sharpness", "weight"):
            np.testing.assert_array_equal(getattr(found[name], field), getattr(lobes, field))


# ── what is seen of them ──────────────────────────────────────────────────────────────────────────────────────────────

RNG = np.random.default_rng(4)


def unit(*shape):
    v = torch.from_numpy(RNG.normal(size=(*shape, 3)))
    return v / v.norm(dim=-1, keepdim=True)


def points():
    """Unit normals and views at most 80° from them."""
    normals = unit(30)
    views = normals + 0.9 * unit(30)
    return normals, views / views.norm(dim=-1, keepdim=True)


def directions(count=256):
    return torch.from_numpy(fibonacci_sphere(count))


def behind(edge, d):
    """Visibility of points that do not see beyond a plane edge: n points, k directions."""
    return (d @ edge.T > 0).T.double()


def weights_of(part, normals, views, d, roughness=0.4):
    if part == "diffuse":
        return cosine_weights(normals, d)
    return highlight_weights(normals, views, d, roughness)


PARTS = pytest.mark.parametrize("part", ["diffuse", "specular"])


@PARTS
def test_who_sees_everything_sees_all_of_every_lobe_and_shares_lie_between_none_and_all(part):
    (normals, views), d = points(), directions()
    lobes = kernel(d, unit(50), torch.logspace(-1, 3.3, 50).double())
    weights, some = weights_of(part, normals, views, d), torch.from_numpy((RNG.random((30, 256)) > 0.5).astype(float))
    np.testing.assert_array_equal(visible_share(torch.ones(30, 256).double(), weights, lobes), 1)
    share = visible_share(some, weights_of(part, normals, views, d, 0.1), lobes)
    assert share.min() >= 0 and share.max() <= 1 + 1e-12


def test_constant_light_is_seen_through_the_cosine_weighted_open_part_of_the_hemisphere():
    """A plane edge tilted by t from the normal leaves (1 + cos t)/2 of the cosine-weighted hemisphere."""
    normals, d = unit(40), directions(1024)
    tilt = torch.linspace(0, 1.5, 40).double()[:, None]
    across = torch.linalg.cross(normals, unit(40))
    edge = torch.cos(tilt) * normals + torch.sin(tilt) * across / across.norm(dim=1, keepdim=True)
    share = visible_share(
        behind(edge, d), cosine_weights(normals, d), kernel(d, unit(1), torch.tensor([1e-3]).double())
    )
    np.testing.assert_allclose(share, (1 + torch.cos(tilt)) / 2, atol=0.02)


# ── at a finite distance ──────────────────────────────────────────────────────────────────────────────────────────────

AXES, CURVATURE = fibonacci_sphere(4000), 0.2
SOLID_ANGLE = 4 * np.pi / len(AXES)


def smooth_light(z):
    """Radiance of the sphere of light, by the direction from its middle."""
    return 1 + 0.9 * z[..., 0] * z[..., 1] + 2 * np.exp(4 * (z @ np.array([0.6, 0, -0.8]) - 1))


@pytest.fixture(scope="module")
def places():
    rng = np.random.default_rng(0)
    place, normal, view = rng.normal(size=(3, 40, 3))
    place *= (rng.uniform(0, 2, 40) / np.linalg.norm(place, axis=1))[:, None]
    return place, *(v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, view))


def irradiance(cosine, larger):
    return np.maximum(cosine, 0) * larger @ smooth_light(AXES) * SOLID_ANGLE


def test_irradiance_beside_the_middle_is_that_of_rays_to_the_sphere_of_light(places):
    place, normal, view = places
    nz, _, larger = finite_distance_cosines(place, normal, view, AXES, CURVATURE)
    X = CURVATURE * place
    along = X @ AXES.T  # of rays in directions AXES from X, t is where they meet the unit sphere
    t = -along + np.sqrt(along**2 + 1 - (X**2).sum(1)[:, None])
    met = X[:, None] + t[..., None] * AXES
    traced = (np.maximum(normal @ AXES.T, 0) * smooth_light(met)).sum(1) * SOLID_ANGLE
    np.testing.assert_allclose(irradiance(nz, larger), traced, rtol=0.01)
    assert np.abs(irradiance(normal @ AXES.T, 1.0) / traced - 1).max() > 0.1
