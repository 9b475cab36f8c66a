"""Cameras, poses and directions agree with COLMAP and the laws of frames; what a pixel sees, and what hides the light from it."""

import numpy as np
import pycolmap
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.occlusion import Occluders, SurfacePoints
from factorlib.geometry.raster import rasterise
from factorlib.geometry.sphere import BINS, NO_OCCLUDER, fibonacci_sphere, mirror_directions
from tests.align.scenes import ball, blob, mesh_of, photo_of

CAMERA = Camera(64, 48, 80.0, (30.0, 25.0))
STILL = Pose(np.eye(3), np.array([0.1, -0.2, 4.0]))


def test_sphere_in_closed_form():
    maps = rasterise(mesh_of([ball(subdivisions=5)]), CAMERA, STILL)
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)  # pixel centres at 0.5
    ray = np.stack([(x - 30) / 80, (y - 25) / 80, np.ones_like(x)], axis=-1)
    a, b, c = np.sum(ray**2, axis=-1), ray @ STILL.translation, STILL.translation @ STILL.translation - 1
    inner = b**2 - a * c > 0.05  # away from the contour
    depth = (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    normal = ray * depth[..., None] - STILL.translation
    assert np.all(maps.label[inner] == 1) and np.all(maps.label[b**2 - a * c < -0.05] == 0)
    assert np.allclose(maps.depth[inner], depth[inner], atol=2e-3)
    assert np.rad2deg(np.arccos(np.clip(np.sum(maps.normal * normal, axis=-1)[inner], -1, 1))).max() < 1.0
    assert np.allclose(maps.view[inner], -(ray / np.sqrt(a)[..., None])[inner])


def test_inside_of_an_open_shell_is_marked_and_faces_the_viewer():
    bowl = ball()
    bowl.update_faces(bowl.triangles_center[:, 2] > 0)  # opening toward the camera at −z
    maps = rasterise(mesh_of([bowl]), CAMERA, STILL)
    visible = maps.label > 0
    assert maps.back[visible].mean() > 0.9 and maps.normal[visible][:, 2].max() < 0
    assert not rasterise(mesh_of([ball()]), CAMERA, STILL).back.any()


def test_nearest_of_several_objects_wins():
    near, far = mesh_of([ball(0.4)], [2]), mesh_of([ball(1.0)], [1])
    maps = rasterise([far, near], CAMERA, [STILL, Pose(np.eye(3), np.array([0.1, -0.2, 2.5]))])
    assert set(np.unique(maps.object)) == {0, 1, 2} and np.array_equal(maps.label == 2, maps.object == 2)
    assert maps.object[21, 32] == 2 and maps.depth[21, 32] == pytest.approx(2.1, abs=0.02)
    other = rasterise([near, far], CAMERA, [Pose(np.eye(3), np.array([0.1, -0.2, 2.5])), STILL])
    assert np.array_equal(other.label, maps.label) and np.array_equal(other.normal, maps.normal)


def test_projection_is_colmaps():
    _, camera, pose = photo_of(blob(), seed=0)
    points = np.random.default_rng(0).normal(size=(20, 3))
    in_camera = pose.apply(points)
    there = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
    assert np.allclose(in_camera, np.array([there * p for p in points]))
    assert np.allclose(camera.project(in_camera), camera.colmap().img_from_cam(in_camera))


def test_a_mirror_shows_what_lies_as_far_beyond_the_normal():
    rng = np.random.default_rng(0)
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 20, 3)))
    mirror = mirror_directions(normal, view)
    assert np.allclose(np.linalg.norm(mirror, axis=1), 1)
    assert np.allclose(np.sum(mirror * normal, 1), np.sum(view * normal, 1))
    assert np.allclose(mirror_directions(normal, mirror), view)


# ── visibility ────────────────────────────────────────────────────────────────────────────────────────────────────────

SQUARE = Camera(64, 64, 100.0, (32.0, 32.0))
AWAY = Pose(Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([0.1, -0.1, 5.0]))


def pixels(meshes, poses):
    """x, y and normals of the pixels that show an object, and the object each shows."""
    maps = rasterise(meshes, SQUARE, poses)
    y, x = np.nonzero(maps.object)
    return x, y, maps.normal[y, x], maps.object[y, x]


def seen_by(meshes, poses, count=256):
    x, y, normal, thing = pixels(meshes, poses)
    result = Occluders(meshes, poses).visibility_at(SQUARE, np.column_stack([x, y]), normal, count, 10_000)
    return result and result.visibility, normal, thing


def open_share(seen, normal):
    """Cosine-weighted share of the hemisphere that is seen."""
    weight = np.maximum(normal @ fibonacci_sphere(seen.shape[1]).T, 0)
    return np.sum(weight * (seen / 255), 1) / weight.sum(1)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("part", [
    ball(subdivisions=1), ball(subdivisions=3), trimesh.creation.box(extents=(1.5, 1, 0.7)),
    trimesh.creation.cylinder(0.4, 1.5, sections=12),
])  # fmt: skip
def test_no_convex_mesh_hides_anything_from_itself_however_coarse(part, scale):
    """Smooth normals lean up to 30° away from the faces here."""
    mesh = mesh_of([part.copy().apply_scale(scale)], crease_deg=60.0)
    assert seen_by([mesh], [Pose(AWAY.rotation, AWAY.translation * scale)])[0] is None


def test_a_ball_over_a_floor_hides_its_form_factor():
    """A ball of radius r, its centre at distance d and angle θ from a floor's normal, wholly above the horizon, covers
    (r/d)² cos θ of the cosine-weighted hemisphere."""
    floor, radius, height = mesh_of([trimesh.creation.box(extents=(8, 8, 0.1))]), 0.5, 1.5
    facing = Pose(np.eye(3), np.array([0.0, 0.0, 6.05]))  # its upper side, z = 6, faces the camera
    centre = np.array([0.6, 0.0, 6 - height])
    visible, normal, thing = seen_by([floor, mesh_of([ball(radius, 4)])], [facing, Pose(np.eye(3), centre)], count=2048)
    x, y, *_ = pixels([floor, mesh_of([ball(radius, 4)])], [facing, Pose(np.eye(3), centre)])
    place = SQUARE.rays_through(np.column_stack([x, y]) + 0.5) * 6
    to_centre = centre - place
    distance = np.linalg.norm(to_centre, axis=1)
    expected = (radius / distance) ** 2 * height / distance
    on_floor = thing == 1
    assert expected[on_floor].max() > 0.09
    np.testing.assert_allclose(1 - open_share(visible, normal)[on_floor], expected[on_floor], atol=0.008)


def test_codes_say_which_material_hides_a_direction_and_how_it_faces():
    """A floor of material 1 under a ball of material 3: straight up the floor meets the ball's underside."""
    floor = mesh_of([trimesh.creation.box(extents=(8, 8, 0.1))])
    thing = mesh_of([ball(1.0, 4)], [3])
    poses = [Pose(np.eye(3), np.array([0.0, 0.0, 6.05])), Pose(np.eye(3), np.array([0.0, 0.0, 3.5]))]
    occluders, directions = Occluders([floor, thing], poses), fibonacci_sphere(256)
    place = np.array([[1.5, 0.0, 5.99], [3.5, 0.0, 5.99]])
    up = np.tile([0.0, 0.0, -1.0], (2, 1))
    past = occluders.visibility_from(SurfacePoints(place, up, np.ones(2, bool)), up, directions)
    hidden = past.visibility == 0
    assert hidden[0].any() and (past.occluder[~hidden] == NO_OCCLUDER).all()
    material, faces = np.divmod(past.occluder[hidden].astype(int), BINS)
    assert (material == 2).all()
    row, k = np.nonzero(hidden)
    toward_floor = np.sum(fibonacci_sphere(BINS)[faces] * directions[k], 1)
    assert (toward_floor < 0.2).all(), "to the width of a bin"
