"""Path-traced photos: other views and lights obey the laws of geometry, and a plane is where things stand."""

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.errors import InputError
from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.light.lobes import Lobes
from factorlib.meshes.mesh import Mesh
from factorlib.render.ground import Plane, resting_plane
from factorlib.render.photo_scene import (
    Orbit,
    PhotoScene,
    PlacedMesh,
    lit_ball,
    traced_photo,
    turned_light,
    with_sun,
)
from factorlib.render.placement import spot_at, spot_beside, standing_mesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import rigid

CAMERA = Camera(48, 40, 60.0, (26.0, 18.0))
MATERIALS = {
    "red": Reflectance((0.6, 0.2, 0.1), (0.1, 0.1, 0.1), 0.4),
    "grey": Reflectance((0.4,) * 3, (0.0,) * 3, 1.0),
}


def lobes() -> Lobes:
    axis, weight = np.array([[0.3, -0.9, -0.2], [-0.7, -0.2, -0.6]]), np.array([[0.5, 0.6, 0.9], [4.0, 3.0, 2.0]])
    return Lobes(axis / np.linalg.norm(axis, axis=1, keepdims=True), np.array([2.0, 20.0]), weight)


def placed(name, mesh, where, rotation=np.eye(3)) -> PlacedMesh:
    return PlacedMesh(name, mesh, ("red",), rigid(rotation, where))


def box(width: float, height: float, depth: float) -> Mesh:
    solid = trimesh.creation.box((width, height, depth))
    faces = np.arange(36, dtype=np.int32).reshape(12, 3)
    return Mesh(solid.triangles.reshape(-1, 3), faces, np.repeat(solid.face_normals, 3, axis=0), np.ones(12, np.int16))


@pytest.fixture
def scene():
    objects = (placed("left", box(1, 1.4, 0.6), (-0.6, 0, -6)), placed("right", sphere(1.0), (1.2, -0.2, -7)))
    return PhotoScene(CAMERA, objects, lobes(), MATERIALS)


def differ(a, b):
    """Of the mean, over 8 × 8 pixels: noise averages out."""
    means = [x[:40, :48].reshape(5, 8, 6, 8, -1).mean(axis=(1, 3)) for x in (a, b)]
    return np.abs(means[0] - means[1]).max() / means[0].max()


def about(axis, degrees):
    return rotation_of_vector(np.radians(degrees) * np.array(axis, float))


def test_the_camera_goes_right_and_up_and_keeps_its_distance_and_no_turn_is_the_photo_itself(scene):
    moved, near = Orbit(30, 20).world_from_camera(scene)[:3, 3], Orbit(0, zoom=2).world_from_camera(scene)[:3, 3]
    far = np.linalg.norm(scene.middle)
    assert moved[0] > 0 and moved[1] > 0 and np.linalg.norm(moved - scene.middle) == pytest.approx(far)
    assert np.linalg.norm(near - scene.middle) == pytest.approx(far / 2)
    assert np.allclose(Orbit(0).world_from_camera(scene), Orbit(360).world_from_camera(scene), atol=1e-9)
    assert np.array_equal(
        traced_photo(scene, 4), traced_photo(scene, 4, world_from_camera=Orbit(0).world_from_camera(scene))
    )


def test_turning_camera_objects_and_light_together_changes_nothing(scene):
    """About the upright axis through the camera."""
    whole = rigid(about((0, 1, 0), 50), np.zeros(3))
    objects = [
        msgspec.structs.replace(each, world_from_object=whole @ each.world_from_object) for each in scene.objects
    ]
    other = msgspec.structs.replace(scene, objects=tuple(objects), light=turned_light(scene.light, 50))
    assert (
        differ(
            traced_photo(scene, 256),
            traced_photo(other, 256, world_from_camera=whole @ Orbit(0).world_from_camera(scene)),
        )
        < 0.02
    )


@pytest.mark.parametrize("angle", [0, 70])
def test_lobes_and_their_map_are_the_same_light(scene, angle):
    """Also turned: the map's axes are the world's, the lobes' the camera's."""
    as_map = msgspec.structs.replace(scene, light=turned_light(lat_long_of_lobes(scene.light, 64, 128), angle))
    as_lobes = msgspec.structs.replace(scene, light=turned_light(scene.light, angle))
    assert differ(traced_photo(as_lobes, 256), traced_photo(as_map, 256)) < 0.02


def test_a_box_stands_on_its_largest_side_that_looks_down():
    tilted = about((1, 0, 0), 25)
    plane = resting_plane(placed("box", box(2, 1, 1.5), (0, 0, -5), rotation=tilted))
    assert np.allclose(plane.normal, tilted @ [0, 1, 0], atol=1e-6)
    assert (plane.point - np.array([0, 0, -5])) @ plane.normal == pytest.approx(-0.5)


AXIS = np.array([0.6, -0.48, -0.64])


@pytest.mark.parametrize("size, share", [(0.53, 0.8), (30.0, 0.3), (5.0, 0.0), (0.1, 1.0)])
def test_an_assumed_sun_takes_its_share_of_the_energy_from_the_rest_and_from_other_suns(size, share):
    one = with_sun(lobes(), np.array([0.0, 0.0, -1.0]), 0.53, 0.4)
    assert np.allclose(one.energy, lobes().energy, rtol=1e-12) and one.suns.sum() == 1
    two = with_sun(one, AXIS, size, share)
    assert np.allclose(two.energy, lobes().energy, rtol=1e-12) and np.array_equal(two.axis[-1], AXIS)
    assert len(two) == len(lobes()) + 1  # it replaces the sun that was there
    last = np.arange(len(two)) == len(two) - 1
    assert np.allclose(two.take(last).energy, share * two.energy, rtol=1e-9)
    assert np.allclose(two.take(~last).weight / lobes().weight, 1 - share)
    alone = two.take(last)
    assert np.allclose(
        with_sun(alone, AXIS, 0.53, 0.1).energy, alone.energy, rtol=1e-9
    )  # nothing but a sun: it keeps all


@pytest.mark.parametrize("size", [0.53, 1.5, 4.0])
def test_a_sun_lights_a_ball_as_its_irradiance_says_and_stands_where_its_axis_says(size):
    """k_d/π · E · cos, as a disc beyond the scene and as a lobe of the map; its shadow is as sharp as it is wide."""
    dark = Lobes(AXIS[None], np.ones(1), np.full((1, 3), 1e-6))
    light = with_sun(dark, AXIS, size, 1.0).scaled(1e6)
    ball = lit_ball(light, MATERIALS["grey"], 64, 256)[..., 0]
    row, column = np.unravel_index(ball.argmax(), ball.shape)  # the camera sees x right and y down of the light's axes
    assert abs(column + 0.5 - 32 * (1 + 0.6)) < 4 and abs(row + 0.5 - 32 * (1 - 0.48)) < 4
    assert ball.max() == pytest.approx(0.4 / np.pi * light.energy[0], rel=0.02)


def test_a_new_object_stands_on_the_plane_as_high_as_asked_turned_and_upright(scene):
    left = scene.objects[0]
    plane = resting_plane(left)
    spot = spot_beside(scene, plane, left, 0.5, 1.0)
    new = standing_mesh("new", box(0.2, 0.3, 3.0), ("red",), np.array([0, 0, 1.0]), 40, spot)
    along = (new.vertices - plane.point) @ plane.normal
    assert along.min() == pytest.approx(0, abs=1e-9) and along.max() == pytest.approx(0.7)
    foot = plane.onto(((new.vertices.min(axis=0) + new.vertices.max(axis=0)) / 2)[None])[0]
    assert np.allclose(foot, spot.point, atol=1e-9)
    assert spot.point[0] < left.vertices[:, 0].min()  # on the left, for the ball stands on the right


def test_a_pixel_names_the_spot_that_it_shows(scene):
    plane = Plane(np.array([0, 1.0, 0]), np.array([0, -0.7, -6]))
    spot = spot_at(scene, plane, scene.objects[0], (30.5, 33.0), 0.5)
    ray = CAMERA.rays_through(np.array([[30.5, 33.0]]))[0] * [1, -1, -1]
    assert np.allclose(np.cross(spot.point, ray), 0, atol=1e-9) and spot.point[1] == pytest.approx(-0.7)
    with pytest.raises(InputError, match="above the horizon"):
        spot_at(scene, plane, scene.objects[0], (30.5, 3.0), 0.5)
