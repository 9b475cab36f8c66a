"""Photos warped through meshes: what they show of a plane, what is hidden from them, and which of them is taken."""

import msgspec
import numpy as np
import pytest

from factorlib.evaluate.picture_errors import ComparedPhoto
from factorlib.evaluate.predicted_views import PosedPhoto, compare_view, warp_photos
from factorlib.geometry.camera import rotation_of_vector
from factorlib.results.poses import CameraEntry, ObjectPose, PhotoPoses

SIZE, CAMERA = 40, CameraEntry(focal_px=60.0, principal_point=(20.0, 20.0))


def photo_of_plane(turn_deg: float, brightness: float = 1.0, label: int = 1) -> PosedPhoto:
    """A square of the plane z = 0, seen from a distance of 4; brighter to the right."""
    rotation = rotation_of_vector(np.radians(turn_deg) * np.array([0.0, 1.0, 0.0]))
    rays = CAMERA.camera(SIZE, SIZE).rays()
    depth = 4 * rotation[2, 2] / (rays @ rotation[:, 2])  # the rotated plane contains (0, 0, 4)
    on_plane = (rays * depth[..., None] - [0, 0, 4]) @ rotation
    inside = np.abs(on_plane).max(axis=-1) < 0.8
    picture = brightness * (2 + on_plane[..., :1]) * [1.0, 0.7, 0.4] * inside[..., None]
    compared = ComparedPhoto(picture, 0.5 * picture, label * inside, inside, 1.0, {}, None)
    pose = ObjectPose(tuple(map(tuple, rotation.tolist())), (0.0, 0.0, 4.0))
    normal = -rotation[:, 2] * np.sign(rotation[2, 2])
    maps = {f"normal.{axis}": normal[k] * inside for k, axis in enumerate("xyz")}
    maps |= {"depth": depth * inside, "object": 1 * inside}
    return PosedPhoto(compared, PhotoPoses(CAMERA, {"wall": pose}), maps)


PHOTO = photo_of_plane(10)
PIXELS = PHOTO.compared.pixels


def test_a_photo_warped_onto_itself_is_itself():
    radiance, visible = warp_photos(PHOTO, [PHOTO])
    assert visible.all()
    np.testing.assert_allclose(radiance, PHOTO.compared.photo[PIXELS], rtol=1e-6)


def test_another_photo_of_a_plane_shows_the_same_up_to_its_exposure_and_beats_flat_colours():
    other = photo_of_plane(-15, brightness=3.0)
    radiance, visible = warp_photos(PHOTO, [other])
    assert visible.mean() > 0.9 and not radiance[~visible].any()
    np.testing.assert_allclose(radiance[visible], 3 * PHOTO.compared.photo[PIXELS][visible], rtol=2e-3)
    scores = compare_view(PHOTO, [other])
    assert scores.nearest_photo > scores.flat + 10 and scores.visible == pytest.approx(visible.mean(), abs=1e-6)
    assert scores.flat == pytest.approx(scores.mean_colour)  # of one material
    assert compare_view(PHOTO, []).nearest_photo == scores.flat


def test_the_photo_from_the_nearest_direction_is_taken_whatever_the_order():
    near, far = photo_of_plane(20, brightness=2.0), photo_of_plane(-30, brightness=5.0)
    for sources in ([near, far], [far, near]):
        radiance, _ = warp_photos(PHOTO, sources)
        middle = PHOTO.compared.photo[20, 20]
        np.testing.assert_allclose(radiance[PIXELS.ravel()[: 20 * SIZE + 20].sum()], 2 * middle, 2e-3)


def test_points_that_are_hidden_uncounted_of_another_material_or_badly_posed_are_not_taken():
    other = photo_of_plane(-15)
    depth = other.geometry["depth"].copy()
    depth[:, :20] *= 0.9  # something stands before the left half
    hidden = msgspec.structs.replace(other, geometry={**other.geometry, "depth": depth})
    _, visible = warp_photos(PHOTO, [hidden])
    columns = np.nonzero(PIXELS)[1]
    assert not visible[columns < 19].any() and visible[columns > 21].mean() > 0.9
    counted = msgspec.structs.replace(other.compared, pixels=np.zeros_like(PIXELS))
    doubtful = msgspec.structs.replace(other.poses.objects["wall"], left_out=True)
    for source in (
        msgspec.structs.replace(other, compared=counted),
        msgspec.structs.replace(other, poses=PhotoPoses(CAMERA, {"wall": doubtful})),
        msgspec.structs.replace(other, poses=PhotoPoses(CAMERA, {"floor": other.poses.objects["wall"]})),
        photo_of_plane(-15, label=2),
        photo_of_plane(190),  # from behind
    ):
        assert not warp_photos(PHOTO, [source])[1].any()
