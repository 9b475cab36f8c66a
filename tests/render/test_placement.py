"""Where a new object stands: through no other, in the picture, and not further from its spot than it must."""

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera
from factorlib.light.lobes import no_lobes
from factorlib.meshes.mesh import Mesh, smooth
from factorlib.render.ground import Plane
from factorlib.render.photo_scene import PhotoScene, PlacedMesh
from factorlib.render.placement import STEP, Spot, free_placement, spot_at, standing_mesh
from factorlib.tracing.scene import rigid

GROUND, UP = Plane(np.array([0, 1.0, 0]), np.array([0, -1.0, -6])), np.array([0, 1.0, 0])
CAMERA = Camera(64, 48, 70.0, (32.0, 20.0))
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
BOX = smooth(CORNERS, np.array([[q[0], q[k], q[k + 1]] for q in SIDES for k in (1, 2)]))


def at(mesh: Mesh, place, size=1.0, turn=None) -> PlacedMesh:
    rotation = np.eye(3) if turn is None else turn
    return PlacedMesh("there", mesh, ("grey",), rigid(size * rotation, place))


def scene(*objects: PlacedMesh) -> PhotoScene:
    return PhotoScene(CAMERA, objects, no_lobes(), {})


def stand(spot: Spot) -> PlacedMesh:
    return standing_mesh("new", sphere(1.0), ("red",), UP, 0.0, spot)


def test_a_ball_in_a_ball_moves_until_they_touch_and_stays_there():
    there, spot = at(sphere(0.5), (0.3, -0.5, -6.2)), Spot(GROUND, np.array([0.2, -1.0, -6.0]), 0.6)
    new, moved, words = free_placement(scene(there), stand, spot, asked=True, factor=2)
    between = np.linalg.norm(new.vertices.mean(axis=0) - there.vertices.mean(axis=0))
    assert 0.795 < between < 0.8 + 1.5 * STEP * 0.6  # of radii .5 and .3
    far = np.linalg.norm(moved.point - spot.point)
    shortest = np.sqrt(0.8**2 - 0.2**2) - np.hypot(0.1, 0.2)  # middles of balls of different size on one plane
    assert shortest - 0.01 < far < shortest + 1.5 * STEP * 0.6 and abs((moved.point - spot.point) @ UP) < 1e-12
    x, y = 2 * CAMERA.project(moved.point * [1, -1, -1])
    assert words == (
        f"The new object was moved by {far / 0.6:.1f} of its heights, to `at: [{x:.0f}, {y:.0f}]`, because it would intersect 'there'."
    )
    again, same, words = free_placement(scene(there), stand, moved, asked=True)
    assert words == "" and same is moved and np.array_equal(again.vertices, new.vertices)


def test_an_object_that_touches_nothing_stays_where_it_is_asked_for():
    spot = Spot(GROUND, np.array([-0.9, -1.0, -6.0]), 1.2)
    new, there, words = free_placement(scene(at(sphere(1.0), (0.9, 0, -6.5))), stand, spot, asked=False)
    assert words == "" and there is spot and new.vertices[:, 1].min() == pytest.approx(-1.0)


WALL = PlacedMesh("wall", BOX, ("grey",), np.diag([1.0, 1.0, 0.1, 1.0]) + np.outer([0, 0, -4.5, 0], [0, 0, 0, 1]))
CASES = [
    (at(sphere(0.2), (1.5, -0.8, -6)), (3.5, -1.0, -6.0), "outside the picture", "the nearest free place is `at: ["),
    (WALL, (0.0, -1.0, -6.0), "hidden behind other objects", "the nearest free place is `at: ["),
]  # fmt: skip


@pytest.mark.parametrize("other, point, words, cure", CASES)
def test_where_nothing_would_be_seen_it_is_refused_with_a_place_or_moved_unasked(other, point, words, cure):
    spot = Spot(GROUND, np.array(point), 0.8)
    with pytest.raises(InputError, match=words) as error:
        free_placement(scene(other), stand, spot, asked=True)
    assert error.value.key == "at" and cure in error.value.cure
    new, there, said = free_placement(scene(other), stand, spot, asked=False)
    assert words in said
    x, y = (int(v) for v in error.value.cure.split("[")[1].split("]")[0].split(","))
    named = spot_at(scene(other), GROUND, new, (x, y), 1.0)  # the place that is named is where it is moved to
    assert np.linalg.norm(named.point - there.point) < 0.25


def test_an_object_that_fits_nowhere_is_refused_with_a_size_that_does():
    """The camera looks straight down on the ground."""
    down = Plane(np.array([0, 0, 1.0]), np.array([0, 0, -6.0]))
    spot = Spot(down, down.point, 20.0)
    with pytest.raises(
        InputError, match="no free place in the picture: it would intersect 'there' and the camera"
    ) as error:
        free_placement(scene(at(sphere(0.3), (0, 0, -5.7))), stand, spot, asked=False)
    assert error.value.key == "size" and "of its size it is free at `at: [" in error.value.cure
