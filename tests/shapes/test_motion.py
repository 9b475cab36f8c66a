"""Cameras by structure from motion: a body at rest, one that turns before a camera at rest, and photos that do not overlap."""

import msgspec
import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.generate.solids import SHAPES
from factorlib.geometry.camera import angle_between
from factorlib.shapes.hull import hull_overlap
from factorlib.shapes.motion import LEAST_AGREEMENT, cameras_by_motion
from factorlib.shapes.primitive import unit_shape
from tests.shapes.outlines import looking_from, outline, views_of

BLOB = SHAPES["blob"]()
POSES = [looking_from(20 + 15 * (k % 2), 18.0 * k) for k in range(5)]


def turns_off(found):
    """Degrees by which the turn from the first photo to each other one is off."""
    poses = {name: POSES[int(name[1:])] for name in found}
    first = next(iter(found))
    return [
        angle_between(
            poses[n].rotation @ poses[first].rotation.T, found[n].pose.rotation @ found[first].pose.rotation.T
        )
        for n in found
    ]


def test_cameras_about_a_body_at_rest_are_found_and_are_the_same_each_time():
    views, shares = views_of(BLOB, POSES, POSES), []
    found = cameras_by_motion(views, lambda share, what: shares.append(share))
    assert shares == sorted(shares) and len(set(shares)) > 4 * len(views)  # it moves with every photo, twice
    assert list(found) == list(views) and max(turns_off(found)) < 0.5
    assert all(each.focal == pytest.approx(1.3 * 320, rel=0.02) for each in found.values())
    known = msgspec.structs.replace(views["p0"].camera, focal=430.0)
    kept = {name: msgspec.structs.replace(view, camera=known, focal_sigma=0.0) for name, view in views.items()}
    assert {each.focal for each in cameras_by_motion(kept).values()} == {430.0}  # what is given is not moved
    again = cameras_by_motion(views)
    assert all(np.array_equal(found[n].pose.rotation, again[n].pose.rotation) for n in found)


def test_of_a_body_that_turns_before_a_camera_at_rest_the_ground_that_stands_still_is_not_believed():
    found = cameras_by_motion(views_of(BLOB, POSES, [POSES[0]] * len(POSES), 480))
    assert len(found) >= 3 and max(turns_off(found)) < 3.0


def test_a_hull_agrees_with_its_masks_where_cameras_move_with_the_body_alone():
    bar = unit_shape("box", np.array([1.0, 0.3, 0.3])).as_mesh()
    moving = [outline(bar, pose, True) for pose in POSES]
    still = [msgspec.structs.replace(one, pose=POSES[0]) for one in moving]
    barely = [msgspec.structs.replace(one, pose=looking_from(20, 0.2 * k)) for k, one in enumerate(moving)]
    assert hull_overlap(moving) > 0.9 and hull_overlap(still) == 0.0  # all from the same side
    assert hull_overlap(barely) < LEAST_AGREEMENT


def test_photos_that_do_not_overlap_are_refused():
    apart = [looking_from(20, 90.0 * k) for k in range(4)]
    with pytest.raises(InputError, match="of 4 photos are found") as error:
        cameras_by_motion(views_of(BLOB, apart, [looking_from(20, 40 + 90.0 * k) for k in range(4)]))
    assert "each 10 to 20° from the next" in error.value.cure
