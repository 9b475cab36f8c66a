"""Lights: lobes, their table and their maps, what is seen of them past other surfaces and at a finite distance, and the prior on natural light."""

import msgspec
import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.linalg import block_diag

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.distance import finite_distance_cosines
from factorlib.light.latlong import lat_long_of_lobes, map_energy, sample_map
from factorlib.light.lobes import Lobes, is_hard, lobe_energy, no_lobes
from factorlib.light.prior import MIX, LightPrior, read_light_prior
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
    assert lobe_energy(sharpness) == pytest.approx(expected, rel=1e-9)


def test_a_light_is_hard_where_a_small_cone_holds_a_quarter_of_it():
    axis = fibonacci_sphere(400)
    even = np.ones(400)
    for share, hard in ((0.2, False), (0.3, True)):
        lamp = np.where(axis @ axis[7] > np.cos(np.radians(8)), 1.0, 0)
        assert is_hard(axis, (1 - share) * even / even.sum() + share * lamp / lamp.sum()) == hard
    assert not is_hard(np.zeros((0, 3)), np.zeros(0)) and not is_hard(axis, 0 * even)


def test_table_round_trip_is_exact_and_byte_equal(tmp_path):
    lights = {"b": some_lobes(3, 1), "dark": no_lobes(), "a": some_lobes(4, 2)}
    write_lobes(tmp_path / "1.parquet", lights)
    write_lobes(tmp_path / "2.parquet", dict(reversed(lights.items())))
    assert (tmp_path / "1.parquet").read_bytes() == (tmp_path / "2.parquet").read_bytes()
    result = read_lobes(tmp_path / "1.parquet")
    assert set(result) == set(lights)
    for name, lobes in lights.items():
        for field in ("axis", "sharpness", "weight"):
            np.testing.assert_array_equal(getattr(result[name], field), getattr(lobes, field))


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


def weights_of(part, normals, views, d, roughness=0.4):
    return cosine_weights(normals, d) if part == "diffuse" else highlight_weights(normals, views, d, roughness)


@pytest.mark.parametrize("part", ["diffuse", "specular"])
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
    above = (d @ edge.T > 0).T.double()  # n points, k directions
    share = visible_share(above, cosine_weights(normals, d), kernel(d, unit(1), torch.tensor([1e-3]).double()))
    np.testing.assert_allclose(share, (1 + torch.cos(tilt)) / 2, atol=0.02)


# ── at a finite distance ──────────────────────────────────────────────────────────────────────────────────────────────

SPHERE, CURVATURE = fibonacci_sphere(4000), 0.2
SOLID_ANGLE = 4 * np.pi / len(SPHERE)


def smooth_light(z):
    """Radiance of the sphere of light, by the direction from its middle."""
    return 1 + 0.9 * z[..., 0] * z[..., 1] + 2 * np.exp(4 * (z @ np.array([0.6, 0, -0.8]) - 1))


def irradiance(cosine, larger):
    return np.maximum(cosine, 0) * larger @ smooth_light(SPHERE) * SOLID_ANGLE


def test_irradiance_beside_the_middle_is_that_of_rays_to_the_sphere_of_light():
    rng = np.random.default_rng(0)
    place, *others = rng.normal(size=(3, 40, 3))
    place *= (rng.uniform(0, 2, 40) / np.linalg.norm(place, axis=1))[:, None]
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in others)
    nz, _, larger = finite_distance_cosines(place, normal, view, SPHERE, CURVATURE)
    X = CURVATURE * place
    along = X @ SPHERE.T  # of rays in directions AXES from X, t is where they meet the unit sphere
    t = -along + np.sqrt(along**2 + 1 - (X**2).sum(1)[:, None])
    points = X[:, None] + t[..., None] * SPHERE
    traced = (np.maximum(normal @ SPHERE.T, 0) * smooth_light(points)).sum(1) * SOLID_ANGLE
    np.testing.assert_allclose(irradiance(nz, larger), traced, rtol=0.01)
    assert np.abs(irradiance(normal @ SPHERE.T, 1.0) / traced - 1).max() > 0.1


# ── Lat-long maps of lobes: energy, place, frame, turning ───────────────────────────────────────────────────────────


AXES = {
    "side": (0.7, -0.3, 0.6),
    "top": (0.0, -1.0, 0.0),
    "near the bottom": (0.003, 1.0, -0.004),
    "seam": (0.001, 0.2, 1.0),
}  # camera frame


def lobe(axis, sharpness: float) -> Lobes:
    axis = np.asarray(axis, float)[None]
    return Lobes(axis / np.linalg.norm(axis), np.array([sharpness]), np.array([[1.0, 0.5, 2.0]]))


@pytest.mark.parametrize("sharpness", [0.1, 5.0, 300.0, 5000.0, 1e6])
@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_energy_of_the_map_is_the_sum_of_the_lobes_integrals(axis, sharpness):
    light = lobe(axis, sharpness)
    for height in (16, 128):
        np.testing.assert_allclose(map_energy(lat_long_of_lobes(light, height, 2 * height)), light.energy, rtol=1e-5)


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_texels_are_means_of_much_finer_point_samples(axis):
    light, height, finer = lobe(axis, 400.0), 8, 128
    weight = lat_long_solid_angles(height * finer, 2 * height * finer)
    directions = lat_long_directions(height * finer, 2 * height * finer).reshape(-1, 3)
    point = light.rotate(YUP_FROM_CAMERA).radiance(directions).reshape(height, finer, 2 * height, finer, 3)
    expected = (
        np.einsum("ha,hawbc->hwc", weight.reshape(height, finer), point)
        / finer
        / weight.reshape(height, finer).sum(1)[:, None, None]
    )
    np.testing.assert_allclose(lat_long_of_lobes(light, height, 2 * height), expected, atol=1e-4)


@pytest.mark.parametrize(
    ("camera_axis", "row", "column"),
    [
        ((0, 0, -1), 0.5, 0.5),
        ((1, 0, 0), 0.5, 0.25),
        ((-1, 0, 0), 0.5, 0.75),
        ((0.01, -1, 0), 0.0, 0.25),
        ((0.01, 1, 0), 1.0, 0.25),
    ],
    ids=["viewer = centre", "right = a quarter", "left = three quarters", "up = top", "down = bottom"],
)
def test_lobe_lies_where_the_fixed_layout_says(camera_axis, row, column):
    height, width = 32, 64
    i, j = np.unravel_index(
        lat_long_of_lobes(lobe(camera_axis, 2000.0), height, width)[..., 0].argmax(), (height, width)
    )
    assert abs((i + 0.5) / height - row) <= 1 / height and abs((j + 0.5) / width - column) <= 1 / width


def test_sampling_at_texel_centres_gives_the_texels_also_beyond_the_poles():
    lat_long = np.random.default_rng(0).uniform(size=(6, 12, 3))
    np.testing.assert_allclose(sample_map(lat_long, lat_long_directions(6, 12)), lat_long, atol=1e-9)
    np.testing.assert_allclose(
        sample_map(lat_long, np.array([[1e-9, 1.0, 0.0]])), lat_long[None, 0, [2, 3, 8, 9]].mean(1), atol=1e-6
    )


# ── The prior on natural light: what its covariance must be ─────────────────────────────────────────────────────────


KNOWN = LightPrior(
    variance=(1.5, 0.05, 0.1), decay_deg=(40.0, 30.0, 60.0), level=(100.0, 0.1, 0.04), nugget=(0.2, 0.01, 0.01),
    profile=((0.5, 0.1, -0.2), (-0.2, 0.0, 0.05), (0.2, 0.1, 0.0)), cell_deg=20.0, freedom=(4.0, 4.0, 4.0),
)  # fmt: skip


@pytest.mark.parametrize("decay_deg", [1.0, 40.0, 400.0])
def test_covariance_is_that_of_the_equation_and_positive_definite_without_a_nugget(decay_deg):
    prior = msgspec.structs.replace(KNOWN, nugget=(0.0,) * 3, decay_deg=(decay_deg,) * 3)
    for k in range(3):
        covariance = prior.covariance(k, np.concatenate([fibonacci_sphere(150), [[1, 0, 0], [-1, 0, 0], [0, 1, 0]]]))
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]])
    half, quarter = 1.5 * np.exp(-180 / 40) + 100, 1.5 * np.exp(-90 / 40) + 100
    expected = [[101.7, quarter, half], [quarter, 101.7, quarter], [half, quarter, 101.7]]
    np.testing.assert_allclose(KNOWN.covariance(0, directions), expected, rtol=1e-12)


def test_precision_is_the_inverse_of_the_covariance_of_log_radiance():
    directions = fibonacci_sphere(12)
    of_y = block_diag(*(KNOWN.covariance(k, directions) for k in range(3)))
    unmix = np.kron(np.linalg.inv(MIX), np.eye(12))
    precision, log_determinant = KNOWN.precision(directions)
    np.testing.assert_allclose(precision @ unmix @ of_y @ unmix.T, np.eye(36), atol=1e-8)
    other, log_of_other = KNOWN.precision(directions, (2.0, 1.0, 0.5))  # a constant apart, the determinant's logarithm
    assert log_of_other - log_determinant == pytest.approx(
        np.linalg.slogdet(other)[1] - np.linalg.slogdet(precision)[1], abs=1e-9
    )


def test_the_shipped_table_reads_and_beats_its_nulls():
    prior = read_light_prior()
    assert len(prior.made_from) >= 30 and prior.level[0] == 100
    scores = prior.leave_one_out
    assert scores.prior > scores.white_noise and scores.prior > scores.no_profile
    assert np.linalg.eigvalsh(prior.precision(fibonacci_sphere(200))[0]).min() > 0
