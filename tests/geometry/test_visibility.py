"""Cast visibility: convex bodies see everything, occluders hide what geometry says, and few rays do for many points."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.met import BINS, UNMET
from factorlib.geometry.raster import rasterise
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.geometry.visibility import Occluders, Points, sight
from tests.align.scenes import ball, mesh_of

CAMERA = Camera(64, 64, 100.0, (32.0, 32.0))
AWAY = Pose(Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(), np.array([0.1, -0.1, 5.0]))


def pixels(meshes, poses):
    """x, y and normals of the pixels that show an object, and the object each shows."""
    maps = rasterise(meshes, CAMERA, poses)
    y, x = np.nonzero(maps.object)
    return x, y, maps.normal[y, x], maps.object[y, x]


def seen_by(meshes, poses, count=256):
    x, y, normal, thing = pixels(meshes, poses)
    found = sight(Occluders(meshes, poses), CAMERA, np.column_stack([x, y]), normal, count, 10_000)
    return found and found.visibility, normal, thing


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
    seen, normal, thing = seen_by([floor, mesh_of([ball(radius, 4)])], [facing, Pose(np.eye(3), centre)], count=2048)
    x, y, *_ = pixels([floor, mesh_of([ball(radius, 4)])], [facing, Pose(np.eye(3), centre)])
    place = CAMERA.rays_through(np.column_stack([x, y]) + 0.5) * 6
    to_centre = centre - place
    distance = np.linalg.norm(to_centre, axis=1)
    expected = (radius / distance) ** 2 * height / distance
    on_floor = thing == 1
    assert expected[on_floor].max() > 0.09
    np.testing.assert_allclose(1 - open_share(seen, normal)[on_floor], expected[on_floor], atol=0.008)


def test_codes_say_which_material_hides_a_direction_and_how_it_faces():
    """A floor of material 1 under a ball of material 3: straight up the floor meets the ball's underside."""
    floor = mesh_of([trimesh.creation.box(extents=(8, 8, 0.1))])
    thing = mesh_of([ball(1.0, 4)], [3])
    poses = [Pose(np.eye(3), np.array([0.0, 0.0, 6.05])), Pose(np.eye(3), np.array([0.0, 0.0, 3.5]))]
    occluders, directions = Occluders([floor, thing], poses), fibonacci_sphere(256)
    place = np.array([[1.5, 0.0, 5.99], [3.5, 0.0, 5.99]])
    up = np.tile([0.0, 0.0, -1.0], (2, 1))
    past = occluders.seen_from(Points(place, up, np.ones(2, bool)), up, directions)
    hidden = past.visibility == 0
    assert hidden[0].any() and (past.met[~hidden] == UNMET).all()
    material, faces = np.divmod(past.met[hidden].astype(int), BINS)
    assert (material == 2).all()
    row, k = np.nonzero(hidden)
    toward_floor = np.sum(fibonacci_sphere(BINS)[faces] * directions[k], 1)
    assert (toward_floor < 0.2).all(), "to the width of a bin"
