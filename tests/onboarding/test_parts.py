"""Parts by colour: the materials of a made solid are found in a sun that casts shadows, and a plain solid has one."""

from functools import partial

import numpy as np
import pytest

from factorlib.dataset.schema import LEFT_OUT
from factorlib.geometry import open3d as o3d
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster, unit
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.onboarding import parts
from factorlib.onboarding.parts import find_parts, observe_patches
from factorlib.scenes.bodies import photographed_mesh
from factorlib.shapes.outline import Outline
from tests.shapes.outlines import looking_from

CAMERA = Camera(160, 120, 320.0, (80.0, 60.0))
POSES = [looking_from(elevation, 36 * k) for k, elevation in enumerate([10, 40, 25, 5, 50, 15, 35, 20, 45, 30])]
SUN = unit(np.array([[0.3, 1.0, 0.2]]))[0]
JUG = photographed_mesh("jug")
COLOURS = np.array([[0.5, 0.1, 0.08], [0.6, 0.6, 0.55], [0.1, 0.2, 0.4]])


def regions(count: int) -> np.ndarray:
    """Return the region of each face: the nearest of some faces, which belong to `count` regions in turn."""
    centre = JUG.vertices[JUG.faces].mean(axis=1)
    seeds = centre[np.random.default_rng(3).choice(len(centre), 2 * count, replace=False)]
    return np.square(centre[:, None] - seeds).sum(-1).argmin(1) % count


def irradiance() -> np.ndarray:
    """Return the irradiance of each face: a warm sun that casts shadows, and a blue sky."""
    corners = JUG.vertices[JUG.faces]
    centre = corners.mean(axis=1)
    normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    normal *= np.sign((normal * JUG.normals[JUG.faces].mean(axis=1)).sum(1, keepdims=True))
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(JUG.vertices.astype("f4")), o3d.core.Tensor(JUG.faces.astype("u4")))
    total = np.zeros((len(centre), 3))
    sky = [(direction, np.array([0.6, 0.8, 1.0]) / 60) for direction in fibonacci_sphere(60) if direction[1] > 0]
    for direction, colour in [(SUN, np.array([3.0, 2.8, 2.4])), *sky]:
        rays = np.hstack([centre + 0.003 * normal, np.tile(direction, (len(centre), 1))]).astype("f4")
        free = ~scene.test_occlusions(o3d.core.Tensor(rays), nthreads=1).numpy()
        total += (np.maximum(normal @ direction, 0) * free)[:, None] * colour
    return total + 0.02


@pytest.fixture(scope="module")
def lit():
    """Return the outlines of the jug, the number of the visible face of each pixel, and each face's irradiance."""
    faces = [Caster(JUG).cast(CAMERA, pose).face for pose in POSES]
    outlines = [
        Outline(str(k), (face >= 0).astype(int), CAMERA, pose=pose)
        for k, (face, pose) in enumerate(zip(faces, POSES, strict=True))
    ]
    return outlines, faces, irradiance()


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Coarser hulls and fewer parts, in a tenth of the time."""
    for name, value in {"HULL_CELLS": 48, "PATCHES": 20, "DIRECTIONS": 120, "MOST_PARTS": 4}.items():
        monkeypatch.setattr(parts, name, value)


def photo(name: str, radiance: np.ndarray, faces: list[np.ndarray], exposures: np.ndarray) -> np.ndarray:
    """Return a photo with 2 % of noise."""
    k = int(name)
    noise = 1 + 0.02 * np.random.default_rng(k).normal(size=(*faces[k].shape, 3))
    return np.where(faces[k][..., None] >= 0, radiance[faces[k]] * exposures[k], 0.05) * noise


@pytest.mark.parametrize("exposed", [0.0, 0.7])
def test_materials_in_a_sun_are_found_whatever_the_exposures(lit, exposed):
    outlines, faces, light = lit
    truth = regions(3)
    exposures = np.exp(exposed * np.random.default_rng(1).normal(size=(len(outlines), 3)))
    read = partial(photo, radiance=light * COLOURS[truth], faces=faces, exposures=exposures)
    surface = find_parts(observe_patches(outlines, read))
    assert len(surface.shares) == 3 and list(surface.shares) == sorted(surface.shares, reverse=True)
    assert np.sqrt(np.diag(surface.parts.covariance)).max() < 0.26  # 0.23 at one exposure
    for k in (0, 4, 7):
        label = surface.label(outlines[k], read(str(k)))
        inside = faces[k] >= 0
        assert ((label > 0) == inside).all() and (label == LEFT_OUT)[inside].mean() < 0.15
        for material in range(3):
            own = inside & (truth[faces[k]] == material) & (label != LEFT_OUT)
            overlaps = [(own & (label == part)).sum() / (own | (label == part)).sum() for part in (1, 2, 3)]
            assert own.sum() < 100 or max(overlaps) > 0.9


def test_photos_with_fewer_colours_than_parts_are_no_error(lit):
    surface = find_parts(observe_patches(lit[0], lambda name: np.full((CAMERA.height, CAMERA.width, 3), 0.2)))
    assert surface.shares.sum() == pytest.approx(1)


def test_a_plain_solid_in_a_sun_is_one_part(lit):
    outlines, faces, light = lit
    read = partial(photo, radiance=0.6 * light, faces=faces, exposures=np.ones((len(outlines), 1)))
    assert len(find_parts(observe_patches(outlines, read)).shares) == 1
