"""Insertion against a scene that has the object in truth."""

import msgspec
import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera
from factorlib.light.lobes import Lobes
from factorlib.meshes.mesh import Mesh
from factorlib.render.ground import Plane
from factorlib.render.insertion import NEW, GroundSurface, InsertionScene, compared_shadow, inserted, shadow_match
from factorlib.render.photo_scene import ALL_BOUNCES, PhotoScene, PlacedMesh, light_entries, shapes
from factorlib.render.placement import Spot, standing_mesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import bsdf, rendered, rigid, sensor, transform

CAMERA = Camera(64, 48, 70.0, (32.0, 20.0))
MATERIALS = {"red": Reflectance((0.6, 0.2, 0.1), (0.08,) * 3, 0.3), "grey": Reflectance((0.5,) * 3, (0.0,) * 3, 1.0)}
GROUND = Plane(np.array([0, 1.0, 0]), np.array([0, -1.0, -6]))
SPOT = Spot(GROUND, np.array([-0.9, -1.0, -6.0]), 1.2)
STRIPES = (0.2, 0.5)


def stands(scene: PhotoScene, placed: PlacedMesh | None = None, polish: Reflectance | None = None) -> InsertionScene:
    return InsertionScene(scene, GroundSurface(GROUND, polish=polish), placed or new(), SPOT, SPOT, "")


def light() -> Lobes:
    axis, weight = np.array([[0.2, -0.95, 0.1], [0.75, -0.6, 0.2]]), np.array([[0.5, 0.6, 0.8], [20.0, 18.0, 15.0]])
    return Lobes(axis / np.linalg.norm(axis, axis=1, keepdims=True), np.array([1.0, 80.0]), weight)


THERE = PlacedMesh("there", sphere(1.0), ("grey",), rigid(np.eye(3), (0.9, 0, -6.5)))
SCENE = PhotoScene(CAMERA, (THERE,), light(), MATERIALS)
OPEN = np.zeros((CAMERA.height, CAMERA.width), bool)  # nothing covers the ground


def true_photo(objects, samples=1024):
    """Striped ground, which the insertion knows nothing of, beyond the disc too."""
    entries = {**light_entries(light(), 6.0), **shapes(objects, MATERIALS)}
    for k in range(-8, 8):
        frame = rigid(np.stack([[0.5, 0, 0], [0, 0, -40.0], [0, 1.0, 0]], axis=1), (k + 0.5, -1.0, -6))
        stripe = {"type": "rectangle", "to_world": transform(frame)}
        entries[f"stripe{k + 8}"] = stripe | {"bsdf": bsdf(Reflectance((STRIPES[k % 2],) * 3, (0.0,) * 3, 1.0))}
    return rendered(entries, sensor(CAMERA, rigid(YUP_FROM_CAMERA, np.zeros(3))), samples, 7, ALL_BOUNCES)


def new(material="red") -> PlacedMesh:
    return standing_mesh("new", sphere(1.0), (material,), np.array([0, 1.0, 0]), 0.0, SPOT)


@pytest.fixture(scope="module")
def made():
    photo = true_photo([THERE])
    return photo, inserted(stands(SCENE), photo, OPEN, 512)


def match_of(scene, photo):
    return compared_shadow(stands(scene), inserted(stands(scene), photo, OPEN, 64), photo, OPEN, 64)


def blocks(picture):
    return picture.reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))


def test_the_composite_is_the_photo_of_the_scene_with_the_object(made):
    """Shadow on a ground of unknown texture, the object itself, its light on its neighbour: within the noise and the ground's mean colour."""
    photo, found = made
    truth = true_photo([THERE, new()])
    error, change = np.abs(blocks(found.composite) - blocks(truth)), np.abs(blocks(photo) - blocks(truth))
    assert error.mean() < 0.08 * change.mean()
    assert np.sqrt((error**2).mean()) < 0.1 * np.sqrt((change**2).mean())

    assert np.array_equal(found.composite[0], photo[0]) and (found.shadow[0] == 1).all()  # no path joins the sky to it
    assert STRIPES[0] < found.ground.mean() < STRIPES[1]


def test_twice_the_light_is_twice_the_picture_and_a_polished_ground_shows_the_object_and_only_there(made):
    photo, found = made
    brighter = PhotoScene(CAMERA, (THERE,), light().scaled(2.0), MATERIALS)
    polish = Reflectance((0.0,) * 3, (0.5,) * 3, 0.05)
    matt, polished = (inserted(stands(SCENE, polish=p), photo, OPEN, 64) for p in (None, polish))
    again = inserted(stands(brighter), 2 * photo, OPEN, 64)
    assert np.allclose(again.composite, 2 * matt.composite, rtol=1e-4, atol=1e-6)
    difference = np.abs(polished.composite - matt.composite).max(axis=-1)
    rows, columns = np.nonzero(found.coverage > 0)
    below = difference[rows.max() + 1 : rows.max() + 8, columns.min() : columns.max()]
    assert below.max() > 0.05 and difference[0].max() == 0


@pytest.mark.parametrize("turn", [0, 180])
def test_an_open_mesh_is_seen_from_either_side_and_hidden_by_what_stands_before_it(turn):
    """Whatever the objects of the photo are called."""
    corners = np.array([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    quad = Mesh(corners, faces, np.tile([0, 0, 1.0], (4, 1)), np.ones(2, np.int16), open=True)
    seen = []
    for where in (-8.0, -4.0):
        matrix = 0.3 * np.eye(4)
        matrix[:, 3] = (-0.9 * -where / 6, -0.6 * -where / 6, where, 1)
        before = PlacedMesh("new", sphere(1.0), ("grey",), matrix)
        scene = PhotoScene(CAMERA, (before,), light(), MATERIALS)
        placed = standing_mesh(NEW, quad, ("red",), np.array([0, 1.0, 0]), turn, SPOT)
        photo = np.ones((CAMERA.height, CAMERA.width, 3))
        seen.append(inserted(stands(scene, placed), photo, OPEN, 16).coverage.sum())
    assert seen[0] > 100 and seen[1] < 0.9 * seen[0]


def test_the_shadow_of_the_photo_is_recognised_whatever_its_exposure_and_not_where_there_is_none(made):
    """A photo of its own prediction matches fully; light from elsewhere, less than none; objects' pixels do not count."""
    rng = np.random.default_rng(0)
    lit, constant, where = rng.uniform(0.1, 1, (20, 30, 1)) * np.ones(3), np.ones((20, 30, 3)), np.ones((20, 30), bool)
    constant[:10] = 0.5
    assert shadow_match(3 * lit**0.5, lit, constant, where).correlation == pytest.approx(1)
    assert abs(shadow_match(lit, rng.uniform(0.1, 1, lit.shape), constant, where).correlation) < 0.2
    where[:, 3:] = False
    spoiled = np.where(where[..., None], lit, rng.uniform(0.1, 1, lit.shape))
    few = shadow_match(spoiled, lit, constant, where)
    assert few.correlation is None and few.pixels == 60 and "too little of the ground" in str(few)
    where[:, 3:8] = True
    assert shadow_match(np.where(where[..., None], lit, 0.5), lit, constant, where).correlation == pytest.approx(1)
    assert shadow_match(lit, np.ones_like(lit), constant, where).correlation is None

    plain = rendered(
        {**light_entries(light(), 6.0), **shapes([THERE], MATERIALS), "ground": floor()},
        sensor(CAMERA, rigid(YUP_FROM_CAMERA, np.zeros(3))), 128, 7, ALL_BOUNCES,
    )  # fmt: skip
    match = match_of(SCENE, plain)
    turned = msgspec.structs.replace(SCENE, light=Lobes(light().axis * [-1, 1, -1], light().sharpness, light().weight))
    other = match_of(turned, plain)
    assert match.correlation > 0.9 > match.constant_light > other.correlation and match.pixels == other.pixels > 500


def floor() -> dict:
    frame = rigid(np.stack([[40.0, 0, 0], [0, 0, -40.0], [0, 1.0, 0]], axis=1), (0, -1.0, -6))
    return {"type": "rectangle", "to_world": transform(frame), "bsdf": bsdf(MATERIALS["grey"])}
