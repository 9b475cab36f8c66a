"""Photos warped through meshes: what they show of a plane, what is hidden from them, and which of them is taken."""

import numpy as np
import pytest
from msgspec.structs import replace

from factorlib.evaluate.picture_errors import ComparedPhoto
from factorlib.evaluate.predicted_views import PosedPhoto, compare_view, warp_photos
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.results.poses import ObjectPose

CAMERA = Camera(40, 40, 60.0, (20.0, 20.0))


def plane(turn_deg: float, brightness: float = 1.0, label: int = 1) -> PosedPhoto:
    """A square of the plane z = 0 from a distance of 4, turned about the vertical; brighter to the right."""
    rotation = rotation_of_vector(np.radians(turn_deg) * np.array([0.0, 1.0, 0.0]))
    rays = CAMERA.rays()
    depth = 4 * rotation[2, 2] / (rays @ rotation[:, 2])  # the plane contains (0, 0, 4)
    on_plane = (rays * depth[..., None] - [0, 0, 4]) @ rotation
    inside = np.abs(on_plane).max(axis=-1) < 0.8
    picture = brightness * (2 + on_plane[..., :1]) * [1.0, 0.7, 0.4] * inside[..., None]
    compared = ComparedPhoto(picture, 0.5 * picture, label * inside, inside, 1.0, {}, None)
    normal = -rotation[:, 2] * np.sign(rotation[2, 2])
    maps = {f"normal.{axis}": normal[k] * inside for k, axis in enumerate("xyz")}
    pose = ObjectPose(tuple(map(tuple, rotation.tolist())), (0.0, 0.0, 4.0))
    return PosedPhoto(compared, {**maps, "depth": depth * inside, "object": inside}, CAMERA, {"wall": pose})


PHOTO = plane(10)
PIXELS = PHOTO.compared.pixels
SHOWN = PHOTO.compared.photo[PIXELS]
OTHER = plane(-15, brightness=3.0)


def test_a_photo_warped_onto_itself_is_itself_and_another_is_it_up_to_its_exposure():
    for source, factor, share, tolerance in ((PHOTO, 1, 1.0, 1e-9), (OTHER, 3, 0.9, 2e-3)):
        radiance, visible = warp_photos(PHOTO, [source])
        assert visible.mean() >= share and not radiance[~visible].any()
        np.testing.assert_allclose(radiance[visible], factor * SHOWN[visible], rtol=tolerance)
    scores = compare_view(PHOTO, [OTHER])
    assert scores["nearest_photo"] > scores["flat"] + 10 and scores["visible"] > 0.9
    alone = compare_view(PHOTO, [])
    assert alone["nearest_photo"] == alone["flat"] == pytest.approx(alone["mean_colour"]) and alone["visible"] == 0


def test_the_photo_from_the_nearest_direction_is_taken_whatever_the_order():
    near = plane(20, brightness=2.0)
    for sources in ([near, OTHER], [OTHER, near]):
        radiance, _ = warp_photos(PHOTO, sources)
        assert np.median(radiance / SHOWN) == pytest.approx(2, rel=1e-3)


def test_hidden_points_are_not_taken():
    behind = np.arange(40) < 20  # something stands before the left half
    depth = OTHER.geometry["depth"] * np.where(behind, 0.9, 1.0)
    _, visible = warp_photos(PHOTO, [replace(OTHER, geometry={**OTHER.geometry, "depth": depth})])
    columns = np.nonzero(PIXELS)[1]
    assert not visible[columns < 19].any() and visible[columns > 21].mean() > 0.9


@pytest.mark.parametrize("source", [
    plane(190),  # from behind
    plane(-15, label=2),
    replace(OTHER, compared=replace(OTHER.compared, pixels=np.zeros_like(PIXELS))),
    replace(OTHER, objects={"floor": OTHER.objects["wall"]}),
    replace(OTHER, objects={"wall": replace(OTHER.objects["wall"], left_out=True)}),
], ids=["back", "material", "uncounted", "object", "doubtful"])  # fmt: skip
def test_a_photo_that_shows_something_else_is_not_taken(source):
    assert not warp_photos(PHOTO, [source])[1].any()
