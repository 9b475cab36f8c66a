"""Shadows on the ground: radiance of patches relative to that without shadows, and what hides the light from them."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import spearmanr

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.ground import Plane
from factorlib.geometry.occlusion import Occluders
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.urm import cast_shadows as patches
from factorlib.urm.background import RIM, ROWS, surrounding_radiance
from factorlib.urm.cast_shadows import GroundView, ground_observations

CAMERA = Camera(320, 240, 300.0, (160.0, 120.0))
UP = np.array([0.0, -np.cos(0.6), -np.sin(0.6)])  # the camera looks down by 34°
GROUND = Plane(UP, np.array([0.0, 0.3, 4.0]))
BALL = GROUND.point + 1.0 * UP  # centre of a ball of radius 1 that stands on the ground
SUN = np.array([0.7, -0.7, -0.1]) / np.linalg.norm([0.7, -0.7, -0.1])
DIRECTIONS = 512
SKY = 0.5  # irradiance of the sky, relative to the sun's on the unshadowed ground


def hit_ball(start, along):
    """Where rays of unit `along` hit the ball, by hand."""
    to = BALL - start
    near = (to * along).sum(-1)
    return (near > 0) & ((to**2).sum(-1) - near**2 < 1)


def irradiance(point):
    """Light on points of the ground: a sun, and a sky whose hidden share is that of the ball's solid angle."""
    directions = fibonacci_sphere(2000)
    up = directions[directions @ UP > 0]
    cosine = up @ UP
    free = np.array([~hit_ball(p, up) @ cosine for p in point]) / cosine.sum()
    return ~hit_ball(point, SUN) + SKY * free


@pytest.fixture(scope="module")
def scene():
    """Channels of a photo of a ball on a floor, and where its pixels see the floor."""
    rays = CAMERA.rays().reshape(-1, 3)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    ball, point = hit_ball(np.zeros(3), unit), GROUND.hit(rays)
    floor = np.isfinite(point).all(1) & ~ball
    light = np.zeros(len(rays))
    light[floor] = irradiance(point[floor])
    return light, floor, ball, point


def observe(scene, colour=lambda point: 0.4, **changed):
    light, floor, ball, point = scene
    size = (240, 320)
    radiance = np.where(floor, light * colour(np.nan_to_num(point)), 0.3)
    photo = {c: (k * radiance).reshape(size) for c, k in zip("RGB", (1.0, 0.8, 0.5))}
    photo |= {name: np.zeros(size) for name in ("left_out", "clipped.R", "clipped.G", "clipped.B")}
    label = ball.reshape(size).astype(float)
    photo |= {"label": label, "valid": np.ones(size)}
    view = -CAMERA.rays() / np.linalg.norm(CAMERA.rays(), axis=-1, keepdims=True)
    geometry = {f"{name}.{a}": view[..., k] for name in ("normal", "view") for k, a in enumerate("xyz")}
    geometry |= {"depth": np.full(size, 4.0), "label": label, "confidence": np.ones(size), "object": np.ones(size)}
    objects = Occluders([sphere(1.0)], [Pose(np.eye(3), BALL)])
    source = SimpleNamespace(photos=("a",), illuminations=("a",))
    return ground_observations(photo | changed, geometry, GroundView(CAMERA, GROUND, objects), source, DIRECTIONS)


def test_patches_are_as_dark_as_their_shadow(scene):
    seen = observe(scene)
    y, x = seen.y.astype(int), seen.x.astype(int)
    expected = scene[0].reshape(240, 320)[y, x] / (1 + SKY)
    np.testing.assert_allclose(np.median(seen.radiance / expected[:, None]), 1, atol=0.03)
    assert np.corrcoef(seen.radiance.mean(1), expected)[0, 1] > 0.97
    np.testing.assert_allclose(
        seen.radiance, seen.radiance[:, :1].repeat(3, 1), rtol=1e-5
    )  # whatever the floor's colour
    np.testing.assert_allclose(seen.normal, np.tile(UP, (len(seen), 1)), atol=1e-6)
    # visibility of the direction of the sun is the shadow, and its weight is least at the outline
    nearest = np.argmax(fibonacci_sphere(DIRECTIONS) @ SUN)
    hidden, dark = seen.visibility[:, nearest] < 128, seen.radiance.mean(1) < 0.6
    assert 0.05 < dark.mean() < 0.5 and (hidden == dark).mean() > 0.93
    outline = (seen.visibility[:, nearest] > 0) & (seen.visibility[:, nearest] < 255)
    assert seen.weight[outline].mean() < 0.5 * seen.weight[~outline].mean()


def test_lamps_that_are_near_and_things_that_stand_about_change_little(scene):
    plain = observe(scene)
    lamp = observe(scene, lambda p: 0.4 * np.exp(0.3 * p[:, 0] - 0.1 * p[:, 2] ** 2 / 9))
    assert spearmanr(plain.radiance.mean(1), lamp.radiance.mean(1))[0] > 0.85
    thing = observe(scene, lambda p: np.where(np.abs(p[:, 0] - 1.8) < 0.3, 0.9, 0.4))
    assert len(thing) < len(plain) and thing.radiance.max() < 1.4


def tiled(deviation):
    """A floor of tiles of a third, whose colours differ."""
    tiles = np.random.default_rng(0).normal(0, deviation, (100, 100))
    return lambda p: 0.4 * np.exp(tiles[(3 * p[:, 0]).astype(int), (3 * p[:, 2]).astype(int)])


def test_a_patterned_floor_and_one_that_is_hardly_seen_tell_nothing(scene):
    assert observe(scene, tiled(0.3)) is None
    assert observe(scene, left_out=np.ones((240, 320))) is None
    assert observe(scene, **{"clipped.G": np.ones((240, 320))}) is None


def test_a_weak_pattern_counts_less(scene):
    assert observe(scene, tiled(0.03)).weight.mean() < 0.8 * observe(scene).weight.mean()


def test_a_trend_is_removed_by_the_least_degree_that_does(monkeypatch):
    rng = np.random.default_rng(1)
    place, light = rng.uniform(-1, 1, (400, 2)), rng.uniform(size=400)
    shadow = np.where(light < 0.3, -0.5, 0.0)
    bent = 0.3 * place[:, 0] - 0.2 * place[:, 1] ** 2
    for trend, degree in ((0 * bent, 0), (bent, 2)):
        monkeypatch.setattr(patches, "MOST_DEGREE", degree)
        shade, spread = patches.remove_trend(np.tile((trend + shadow - 2)[:, None], 3), place, light)
        np.testing.assert_allclose(shade[:, 0], shadow, atol=0.01)
        assert spread < 0.01
    monkeypatch.setattr(patches, "MOST_DEGREE", 1)
    assert patches.remove_trend(np.tile((bent - 2)[:, None], 3), place, light)[1] > patches.EVEN


# ── Surroundings that a photo shows, by direction from its objects ──────────


SMALL = Camera(160, 120, 110.0, (80.0, 60.0))
STEEP = np.array([0.0, -np.cos(0.4), -np.sin(0.4)])  # the camera looks down by 23°
CENTRE = np.array([0.1, 0.1, 3.0])
FLOOR = Plane(STEEP, CENTRE - 0.5 * STEEP)
TEXELS = lat_long_directions(ROWS, 2 * ROWS) @ YUP_FROM_CAMERA  # of texels, camera frame


def colour(direction):
    """A smooth radiance of the surroundings."""
    return np.exp(0.5 * direction)


def directions_shown(ground):
    """Directions from the objects to what each pixel shows, by hand: a ray that looks down meets the ground."""
    rays = SMALL.rays()
    shown = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    if ground is None:
        return shown
    down = rays @ ground.normal
    points = rays * ((ground.point @ ground.normal) / down)[..., None]
    from_objects = points - CENTRE
    from_objects /= np.linalg.norm(from_objects, axis=-1, keepdims=True)
    return np.where(down[..., None] < 0, from_objects, shown)


def photo(ground=FLOOR):
    channels = dict(zip("RGB", np.moveaxis(colour(directions_shown(ground)), -1, 0)))
    label = np.zeros((120, 160))
    label[40:80, 60:100] = 1
    zero = {name: np.zeros_like(label) for name in ("left_out", "clipped.R", "clipped.G", "clipped.B")}
    channels["R"] = np.where(label > 0, 50.0, channels["R"])  # the object is not of the surroundings
    return channels | zero | {"label": label}


@pytest.mark.parametrize("ground, least", [(FLOOR, 0.15), (None, 0.02)])
def test_a_texel_has_the_radiance_that_comes_from_there(ground, least):
    found = surrounding_radiance(photo(ground), SMALL, CENTRE, ground)
    seen = found.any(-1)
    solid = np.sin((np.arange(ROWS) + 0.5) / ROWS * np.pi)[:, None] * np.ones(2 * ROWS)
    assert solid[seen].sum() / solid.sum() > least
    np.testing.assert_allclose(found[seen], colour(TEXELS)[seen], rtol=0.05)


def test_clipped_black_and_left_out_pixels_and_rims_are_no_observations():
    whole = photo()
    everything = surrounding_radiance(whole, SMALL, CENTRE, FLOOR).any(-1).sum()
    ones = np.ones_like(whole["label"])
    for changed in ({"clipped.G": ones}, {"left_out": ones}, {"B": 0 * ones}, {"R": np.nan * ones}):
        assert not surrounding_radiance(whole | changed, SMALL, CENTRE, FLOOR).any()
    left = ones.copy()
    left[:, : 80 + RIM] = 0
    assert 0.2 * everything < surrounding_radiance(whole | {"left_out": left}, SMALL, CENTRE, FLOOR).any(-1).sum()
    bright = dict(whole)
    border = np.zeros((120, 160), bool)
    border[40:80, 60 - RIM : 100 + RIM] = True
    bright["R"] = np.where(border & (whole["label"] == 0), 50.0, whole["R"])  # mixed with the object
    assert surrounding_radiance(bright, SMALL, CENTRE, FLOOR)[..., 0].max() < 2
