"""Path-traced photos: other views and lights, the floor of a studio, insertion beside a scene that has the object in truth, where a new object stands, and the light at a place."""

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.generate.solids import sphere
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.geometry.ground import Plane, resting_plane, stable_poses
from factorlib.light.latlong import sample_map
from factorlib.light.lobes import Lobes, lobe_energy, no_lobes
from factorlib.meshes.mesh import Mesh
from factorlib.render.ground import LEVEL_DEG, floor_rim, ground_below, level_ground, on_floor
from factorlib.render.insertion import (
    NEW,
    TURNS,
    GroundSurface,
    InsertionScene,
    compare_shadow,
    insert_object,
    shadow_match,
)
from factorlib.render.photo_scene import (
    ALL_BOUNCES,
    CAMERA_POSE,
    MARGIN,
    Orbit,
    PhotoScene,
    PlacedMesh,
    before_light,
    crop_to_objects,
    light_entries,
    rotate_light,
    shapes,
    traced_photo,
    visible_window,
)
from factorlib.render.placement import (
    CUT,
    STEP,
    FreeSpace,
    Spot,
    free_placement,
    spot_beside,
    standing_mesh,
    unproject_spot,
)
from factorlib.results.materials import Reflectance
from factorlib.tracing import scene as tracing
from factorlib.tracing.scene import bsdf, render_scene, rigid, sensor, transform
from tests.refusal import refusal

SMALL = Camera(48, 40, 60.0, (26.0, 18.0))
COLOURS = {
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
def pair():
    objects = (placed("left", box(1, 1.4, 0.6), (-0.6, 0, -6)), placed("right", sphere(1.0), (1.2, -0.2, -7)))
    return PhotoScene(SMALL, objects, lobes(), COLOURS)


def differ(a, b):
    """Of the mean, over 8 × 8 pixels: noise averages out."""
    means = [x[:40, :48].reshape(5, 8, 6, 8, -1).mean(axis=(1, 3)) for x in (a, b)]
    return np.abs(means[0] - means[1]).max() / means[0].max()


def about(axis, degrees):
    return rotation_of_vector(np.radians(degrees) * np.array(axis, float))


def test_the_camera_goes_right_and_up_and_keeps_its_distance_and_no_turn_is_the_photo_itself(pair):
    moved, near = Orbit(30, 20).world_from_camera(pair)[:3, 3], Orbit(0, zoom=2).world_from_camera(pair)[:3, 3]
    far = np.linalg.norm(pair.middle)
    assert moved[0] > 0 and moved[1] > 0 and np.linalg.norm(moved - pair.middle) == pytest.approx(far)
    assert np.linalg.norm(near - pair.middle) == pytest.approx(far / 2)
    assert np.allclose(Orbit(0).world_from_camera(pair), Orbit(360).world_from_camera(pair), atol=1e-9)
    assert np.array_equal(
        traced_photo(pair, 4), traced_photo(pair, 4, world_from_camera=Orbit(0).world_from_camera(pair))
    )


def test_turning_camera_objects_and_light_together_changes_nothing(pair):
    """About the upright axis through the camera."""
    whole = rigid(about((0, 1, 0), 50), np.zeros(3))
    objects = [msgspec.structs.replace(each, world_from_object=whole @ each.world_from_object) for each in pair.objects]
    other = msgspec.structs.replace(pair, objects=tuple(objects), light=rotate_light(pair.light, 50))
    assert (
        differ(
            traced_photo(pair, 256),
            traced_photo(other, 256, world_from_camera=whole @ Orbit(0).world_from_camera(pair)),
        )
        < 0.02
    )


def test_a_box_stands_on_its_largest_side_that_looks_down():
    tilted = about((1, 0, 0), 25)
    plane = ground_below(placed("box", box(2, 1, 1.5), (0, 0, -5), rotation=tilted))
    assert np.allclose(plane.normal, tilted @ [0, 1, 0], atol=1e-6)
    assert (plane.point - np.array([0, 0, -5])) @ plane.normal == pytest.approx(-0.5)


@pytest.mark.parametrize("tilt, rests", [(LEVEL_DEG - 1, True), (LEVEL_DEG + 1, False)])
def test_in_a_world_a_thing_rests_on_its_level_side_or_stands_on_its_lowest_point_and_so_does_a_ball_beside_it(
    pair, tilt, rests
):
    up = about((1, 0, 1), 25) @ UP
    leaning = placed("box", box(2, 1, 1.5), (0, 0, -5), rotation=about((0, 0, 1), tilt) @ about((1, 0, 1), 25))
    plane, source = level_ground(leaning, up)
    heights = (leaning.vertices - plane.point) @ plane.normal
    assert heights.min() == pytest.approx(0, abs=1e-9) and ("rests" in source) is rests
    lies_on_a_face, is_level = np.ptp(np.sort(heights)[:12]) < 1e-9, plane.normal @ up > 1 - 1e-9
    assert [lies_on_a_face, is_level] == [rests, not rests]
    ball = standing_mesh("ball", sphere(1.0), ("red",), UP, 0.0, spot_beside(pair, plane, leaning, 0.5, 1.0))
    assert ((ball.vertices - plane.point) @ plane.normal).min() == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("across, finest, pixels", [(90, 1.0, 90), (None, 2.0, None), (None, 1e3, 640)])
def test_a_crop_shows_all_objects_where_the_photo_has_them_at_the_scale_that_is_asked_for(pair, across, finest, pixels):
    views = [Orbit(azimuth).world_from_camera(pair) for azimuth in (0, 40)]
    cropped, (left, top, width, height) = crop_to_objects(pair, across, finest, views)
    camera = cropped.camera
    pixel = width / camera.width
    assert height / camera.height == pytest.approx(pixel)
    seen = [(pair.points - view[:3, 3]) @ view[:3, :3] for view in views]
    whole, part = (np.concatenate([each.project(points) for points in seen]) for each in (pair.camera, camera))
    np.testing.assert_allclose(part * pixel + [left, top], whole, atol=1e-9)
    longer = np.ptp(part, axis=0).max()
    assert longer == pytest.approx(pixels or finest * np.ptp(whole, axis=0).max())
    rim = MARGIN * longer
    assert np.allclose(part.min(axis=0), rim) and (part.max(axis=0) + rim <= [camera.width, camera.height]).all()
    shown, _ = crop_to_objects(pair, across, finest, views, floor_rim(pair, PLANE))
    assert shown.camera.focal == camera.focal and shown.camera.width > camera.width


@pytest.mark.parametrize("depth", [0.0, 1e-12])
def test_a_flat_object_rests_nowhere(depth):
    card = np.random.default_rng(0).random((50, 3)) * [1, 1, depth]
    assert resting_plane(card, card, np.eye(3), np.array([[0.0, 1.0, 0.0]])) is None


def test_a_cube_rests_on_each_face_alike_and_an_oblique_prism_not_on_its_base():
    cube = box(1, 1, 1).vertices
    ups, chances = stable_poses(cube)
    np.testing.assert_allclose(np.abs(ups).max(axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(chances, 1 / 6, atol=1e-9)
    leaning = cube + cube[:, 1:2] * [3, 0, 0]  # its centre is half a side to the right of its base
    ups, _ = stable_poses(leaning)
    assert len(ups) and (np.abs(ups[:, 1]) < 0.99).all()


def test_a_new_object_stands_on_the_plane_as_high_as_asked_turned_and_upright(pair):
    left = pair.objects[0]
    plane = ground_below(left)
    spot = spot_beside(pair, plane, left, 0.5, 1.0)
    new = standing_mesh("new", box(0.2, 0.3, 3.0), ("red",), np.array([0, 0, 1.0]), 40, spot)
    along = (new.vertices - plane.point) @ plane.normal
    assert along.min() == pytest.approx(0, abs=1e-9) and along.max() == pytest.approx(0.7)
    foot = plane.onto(((new.vertices.min(axis=0) + new.vertices.max(axis=0)) / 2)[None])[0]
    assert np.allclose(foot, spot.point, atol=1e-9)
    assert spot.point[0] < left.vertices[:, 0].min()  # on the left, for the ball stands on the right


def test_a_pixel_names_the_spot_that_it_shows(pair):
    plane = Plane(np.array([0, 1.0, 0]), np.array([0, -0.7, -6]))
    spot = unproject_spot(pair, plane, pair.objects[0], (30.5, 33.0), 0.5)
    ray = SMALL.rays_through(np.array([[30.5, 33.0]]))[0] * [1, -1, -1]
    assert np.allclose(np.cross(spot.point, ray), 0, atol=1e-9) and spot.point[1] == pytest.approx(-0.7)
    refusal("above the horizon", unproject_spot, pair, plane, pair.objects[0], (30.5, 3.0), 0.5)


# ── A floor takes the shadow of what stands on it, fades out, and changes nothing else ──────────────────────────────


PLANE = Plane(np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, -6.0]))


@pytest.fixture(scope="module")
def studio():
    return PhotoScene(Camera(60, 48, 50.0, (30.0, 24.0)), (placed("ball", sphere(1.0), (0, 0, -6)),), lobes(), COLOURS)


def test_a_shadow_lies_beneath_the_ball_and_nothing_far_from_it(studio):
    view = Orbit(0, 25).world_from_camera(studio)
    plain, dark, pale = (
        traced_photo(studio, 64, view) if share is None else on_floor(studio, PLANE, share, 64, view)
        for share in (None, 0.0, 0.8)
    )
    assert (pale[:3, :, 3] == plain[:3, :, 3]).all(), "the sky is empty as before"
    fading = (plain[..., 3] == 0) & (pale[..., 3] > 0.1) & (pale[..., 3] < 0.9)
    assert fading.sum() > 100, "the floor ends without an edge"
    inside, below = plain[..., 3] > 0.99, (plain[..., 3] == 0) & (pale[..., 3] > 0.5)
    assert below.sum() > 100 and np.abs(dark[below][:, :3]).max() < 1e-3
    rows, columns = np.nonzero(below)
    middle = np.abs(columns - 30) < 4
    colour = pale[..., :3] / np.maximum(pale[..., 3:], 1e-6)
    foot = colour[rows[middle].min(), 27:34].mean()  # at the ball's contact
    assert foot < 0.7 * colour[below].mean(), "where it stands, less light comes"
    assert pale[inside][:, :3].mean() > dark[inside][:, :3].mean(), "the floor lights the ball"
    np.testing.assert_allclose(dark[inside][:, :3].mean(), plain[inside][:, :3].mean(), rtol=0.35)


def test_about_a_tilted_normal_the_camera_keeps_its_height_and_its_distance(studio):
    up = np.array([0.0, 0.8, 0.6])
    places = np.array([Orbit(azimuth).world_from_camera(studio, up)[:3, 3] - studio.middle for azimuth in (0, 90, 180)])
    np.testing.assert_allclose(places @ up, np.full(3, places[0] @ up), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), np.linalg.norm(studio.middle), atol=1e-9)
    upright = msgspec.structs.replace(studio, up=up)  # of a scene whose vertical that is, too
    np.testing.assert_allclose(Orbit(90).world_from_camera(upright)[:3, 3] - studio.middle, places[1], atol=1e-9)


# ── Insertion against a scene that has the object in truth ──────────────────────────────────────────────────────────


CAMERA = Camera(64, 48, 70.0, (32.0, 20.0))
MATERIALS = {"red": Reflectance((0.6, 0.2, 0.1), (0.08,) * 3, 0.3), "grey": Reflectance((0.5,) * 3, (0.0,) * 3, 1.0)}
GROUND = Plane(np.array([0, 1.0, 0]), np.array([0, -1.0, -6]))
SPOT = Spot(GROUND, np.array([-0.9, -1.0, -6.0]), 1.2)
STRIPES = (0.2, 0.5)


def stands(scene: PhotoScene, placed: PlacedMesh | None = None) -> InsertionScene:
    return InsertionScene(scene, GroundSurface(GROUND), placed or new(), SPOT, SPOT, "")


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
    return render_scene(entries, sensor(CAMERA, rigid(YUP_FROM_CAMERA, np.zeros(3))), samples, 7, ALL_BOUNCES)


def new(material="red") -> PlacedMesh:
    return standing_mesh("new", sphere(1.0), (material,), np.array([0, 1.0, 0]), 0.0, SPOT)


@pytest.fixture(scope="module")
def inserted():
    photo = true_photo([THERE])
    return photo, insert_object(stands(SCENE), photo, OPEN, 512)


def match_of(scene, photo):
    return compare_shadow(stands(scene), insert_object(stands(scene), photo, OPEN, 64), photo, OPEN)


def blocks(picture):
    return picture.reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))


@pytest.mark.long
def test_the_composite_is_the_photo_of_the_scene_with_the_object(inserted):
    """Shadow on a ground of unknown texture, the object itself, its light on its neighbour: within the noise and the ground's mean colour."""
    photo, result = inserted
    truth = true_photo([THERE, new()])
    error, change = np.abs(blocks(result.composite) - blocks(truth)), np.abs(blocks(photo) - blocks(truth))
    assert error.mean() < 0.08 * change.mean()
    assert np.sqrt((error**2).mean()) < 0.1 * np.sqrt((change**2).mean())

    assert (
        np.array_equal(result.composite[0], photo[0]) and (result.shadow[0] == 1).all()
    )  # no path joins the sky to it
    assert STRIPES[0] < result.ground.mean() < STRIPES[1]


@pytest.mark.long
def test_twice_the_light_is_twice_the_picture(inserted):
    photo, _ = inserted
    brighter = PhotoScene(CAMERA, (THERE,), light().scale(2.0), MATERIALS)
    once = insert_object(stands(SCENE), photo, OPEN, 64)
    again = insert_object(stands(brighter), 2 * photo, OPEN, 64)
    assert np.allclose(again.composite, 2 * once.composite, rtol=1e-4, atol=1e-6)


def test_an_object_casts_the_shadow_of_the_sun_where_its_direction_says():
    """A ball of radius 0.3 on the plane: its umbra is about the point of the plane that its middle hides from the sun."""
    sun = np.array([0.8, 0.6, 0.0])
    sharp = 4 / np.radians(0.53 / 2) ** 2
    weight = 4 * lobes().energy / lobe_energy(sharp)  # 0.8 of all the light
    light = Lobes(
        *(
            np.concatenate(p)
            for p in zip(
                (lobes().axis, lobes().sharpness, lobes().weight),
                ((YUP_FROM_CAMERA @ sun)[None], [sharp], weight[None]),
            )
        )
    )
    spot = Spot(GROUND, np.array([0.3, -1.0, -6.0]), 0.6)
    ball = standing_mesh("new", sphere(1.0), ("red",), UP, 0.0, spot)
    aside = PlacedMesh("aside", sphere(0.2), ("grey",), rigid(np.eye(3), (-1.6, -0.8, -6)))
    scene = PhotoScene(CAMERA, (aside,), light, MATERIALS)
    insertion = InsertionScene(scene, GroundSurface(GROUND), ball, spot, spot, "")
    result = insert_object(insertion, np.full((CAMERA.height, CAMERA.width, 3), 0.3), OPEN, 64)
    dark = spot.point + 0.3 * UP - sun * 0.3 / sun[1]
    away = np.linalg.norm(insertion.ground_points - dark, axis=-1)
    beside = result.coverage == 0
    assert result.shadow[beside & (away < 0.15)].max() < 0.4
    assert result.shadow[beside & (away > 0.9) & (away < 1.5)].min() > 0.8


def test_every_pixel_that_the_object_changes_is_within_its_reach_and_all_others_are_the_photo():
    """Against both scenes traced as a whole, whose difference is free of noise where no path meets the object."""
    photo = np.random.default_rng(0).uniform(0.1, 0.9, (CAMERA.height, CAMERA.width, 3))
    spot = msgspec.structs.replace(SPOT, height=0.4)
    small = standing_mesh("new", sphere(1.0), ("red",), np.array([0, 1.0, 0]), 0.0, spot)
    insertion = msgspec.structs.replace(stands(SCENE, small), spot=spot)
    result = insert_object(insertion, photo, OPEN, 64)
    ground = insertion.disc(Reflectance(tuple(result.ground), (0.0,) * 3, 1.0))
    new_shapes = shapes([small], MATERIALS)
    without, whole = (insertion.render(e, CAMERA, 1024, 1)[..., :3] for e in (ground, ground | new_shapes))
    changed = np.abs(whole - without).max(axis=-1) * insertion.fade[..., 0] > 0.03 * np.maximum(
        without.max(axis=-1), 0.01
    )
    same = (result.composite == photo).all(axis=-1)
    assert not (changed & same).any() and changed.sum() > 30
    assert same.mean() > 0.5 and (result.shadow[same] == 1).all() and not result.coverage[same].any()


def test_only_the_window_of_the_objects_is_traced_and_it_shows_all_of_them(pair, monkeypatch):
    part = traced_photo(pair, 256)
    monkeypatch.setattr("factorlib.render.photo_scene.visible_window", lambda *_: (slice(0, 40), slice(0, 48)))
    whole = traced_photo(pair, 256)
    np.testing.assert_allclose(part[..., 3], whole[..., 3], atol=0.05)
    assert differ(part, whole) < 0.02
    away = msgspec.structs.replace(pair, objects=(placed("left", box(1, 1, 1), (-90, 0, -6)),))
    assert not traced_photo(away, 1).any()
    behind = np.array([[0.0, 0, -5], [0, 0, 5]])
    assert visible_window(behind, SMALL, CAMERA_POSE) == (slice(0, 40), slice(0, 48))


def test_behind_objects_stands_the_light_of_each_pixels_direction(pair):
    picture = before_light(traced_photo(pair, 16), pair, CAMERA_POSE)
    away = SMALL.rays() / np.linalg.norm(SMALL.rays(), axis=-1, keepdims=True)
    sky = traced_photo(pair, 16)[..., 3] == 0
    assert (picture[..., 3] == 1).all() and sky.any()
    np.testing.assert_allclose(picture[sky][:, :3], pair.light.radiance(away[sky]), rtol=0.02)


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
        seen.append(insert_object(stands(scene, placed), photo, OPEN, 16).coverage.sum())
    assert seen[0] > 100 and seen[1] < 0.9 * seen[0]


def test_the_shadow_of_the_photo_is_recognised_whatever_its_exposure_and_not_where_there_is_none():
    """A photo of its own prediction matches fully; light from elsewhere, less than none; objects' pixels do not count."""
    rng = np.random.default_rng(0)
    lit, constant, where = rng.uniform(0.1, 1, (20, 30, 1)) * np.ones(3), np.ones((20, 30, 3)), np.ones((20, 30), bool)
    constant[:10] = 0.5
    turned = [lit[:, ::-1], constant]
    match = shadow_match(3 * lit**0.5, lit, constant, turned, where)
    assert match.correlation == pytest.approx(1) and match.turned_lights[1] == match.constant_light
    assert abs(shadow_match(lit, rng.uniform(0.1, 1, lit.shape), constant, turned, where).correlation) < 0.2
    where[:, 3:] = False
    spoiled = np.where(where[..., None], lit, rng.uniform(0.1, 1, lit.shape))
    few = shadow_match(spoiled, lit, constant, turned, where)
    assert few.correlation is None and few.pixels == 60 and "too little of the ground" in str(few)
    where[:, 3:8] = True
    masked = np.where(where[..., None], lit, 0.5)
    assert shadow_match(masked, lit, constant, turned, where).correlation == pytest.approx(1)
    assert shadow_match(lit, np.ones_like(lit), constant, turned, where).correlation is None

    plain = render_scene(
        {**light_entries(light(), 6.0), **shapes([THERE], MATERIALS), "ground": floor()},
        sensor(CAMERA, rigid(YUP_FROM_CAMERA, np.zeros(3))), 128, 7, ALL_BOUNCES,
    )  # fmt: skip
    match = match_of(SCENE, plain)
    turned = msgspec.structs.replace(SCENE, light=Lobes(light().axis * [-1, 1, -1], light().sharpness, light().weight))
    other = match_of(turned, plain)
    assert match.correlation > 0.9 > match.constant_light > other.correlation and match.pixels == other.pixels > 500
    assert not match.doubtful and other.doubtful
    assert match.turned_lights[len(TURNS) // 2] == pytest.approx(other.correlation, abs=0.05)  # turned half around


def floor() -> dict:
    frame = rigid(np.stack([[40.0, 0, 0], [0, 0, -40.0], [0, 1.0, 0]], axis=1), (0, -1.0, -6))
    return {"type": "rectangle", "to_world": transform(frame), "bsdf": bsdf(MATERIALS["grey"])}


# ── Where a new object stands: through no other, in the picture, and not further from its spot than it must ─────────


LOW, UP = Plane(np.array([0, 1.0, 0]), np.array([0, -1.0, -6])), np.array([0, 1.0, 0])
DOWN = Plane(np.array([0, 0, 1.0]), np.array([0, 0, -6.0]))  # the camera looks straight down on it


def at(mesh: Mesh, place, size=1.0, turn=None) -> PlacedMesh:
    rotation = np.eye(3) if turn is None else turn
    return PlacedMesh("there", mesh, ("grey",), rigid(size * rotation, place))


def scene_of(*objects: PlacedMesh) -> PhotoScene:
    return PhotoScene(CAMERA, objects, no_lobes(), {})


def stand(spot: Spot) -> PlacedMesh:
    return standing_mesh("new", sphere(1.0), ("red",), UP, 0.0, spot)


def test_a_ball_in_a_ball_moves_until_they_touch_and_stays_there():
    there, spot = at(sphere(0.5), (0.3, -0.5, -6.2)), Spot(LOW, np.array([0.2, -1.0, -6.0]), 0.6)
    new, moved, words = free_placement(scene_of(there), stand, spot, is_requested=True, factor=2)
    between = np.linalg.norm(new.vertices.mean(axis=0) - there.vertices.mean(axis=0))
    assert 0.795 < between < 0.8 + 1.5 * STEP * 0.6  # of radii .5 and .3
    far = np.linalg.norm(moved.point - spot.point)
    shortest = np.sqrt(0.8**2 - 0.2**2) - np.hypot(0.1, 0.2)  # middles of balls of different size on one plane
    assert shortest - 0.01 < far < shortest + 1.5 * STEP * 0.6 and abs((moved.point - spot.point) @ UP) < 1e-12
    x, y = 2 * CAMERA.project(moved.point * [1, -1, -1])
    assert words == (
        f"The new object was moved by {far / 0.6:.1f} of its heights, to `at: [{x:.0f}, {y:.0f}]`, because it would intersect 'there'."
    )
    again, same, words = free_placement(scene_of(there), stand, moved, is_requested=True)
    assert words == "" and same is moved and np.array_equal(again.vertices, new.vertices)


def test_an_object_that_touches_nothing_stays_where_it_is_asked_for():
    spot = Spot(LOW, np.array([-0.9, -1.0, -6.0]), 1.2)
    new, there, words = free_placement(scene_of(at(sphere(1.0), (0.9, 0, -6.5))), stand, spot, is_requested=False)
    assert words == "" and there is spot and new.vertices[:, 1].min() == pytest.approx(-1.0)


@pytest.mark.parametrize("plane, y, height", [(LOW, -1.0, 0.8), (DOWN, 0.0, 5.0)])
def test_an_object_whose_place_nobody_asked_for_is_whole_in_the_picture_or_said_to_be_cut(plane, y, height):
    """The picture ends in the middle of the requested spot; seen from above, the larger object fits nowhere."""
    x = 6.0 * CAMERA.width / 2 / CAMERA.focal
    spot, scene = Spot(plane, np.array([x, y, -6.0]), height), scene_of(at(sphere(0.2), (-4, -0.8, -6)))
    shares = FreeSpace(scene, stand(spot), spot).visible_shares()
    assert 0 < shares[1] <= shares[0] < 0.8
    new, there, words = free_placement(scene, stand, spot, is_requested=False)
    whole = FreeSpace(scene, new, there).visible_shares()[0] == 1
    assert whole == ("because the picture's border would cut it" in words) == (CUT not in words) == (height < 1)
    asked = free_placement(scene, stand, spot, is_requested=True)
    assert asked[1] is spot and asked[2] == CUT


WALL = PlacedMesh(
    "wall", box(2, 2, 2), ("grey",), np.diag([1.0, 1.0, 0.1, 1.0]) + np.outer([0, 0, -4.5, 0], [0, 0, 0, 1])
)
CASES = [
    (at(sphere(0.2), (1.5, -0.8, -6)), (3.5, -1.0, -6.0), "outside the picture", "the nearest free place is `at: ["),
    (WALL, (0.0, -1.0, -6.0), "hidden behind other objects", "the nearest free place is `at: ["),
]  # fmt: skip


@pytest.mark.parametrize("other, point, words, cure", CASES)
def test_where_nothing_would_be_seen_it_is_refused_with_a_place_or_moved_unasked(other, point, words, cure):
    spot = Spot(LOW, np.array(point), 0.8)
    error = refusal(words, free_placement, scene_of(other), stand, spot, is_requested=True)
    assert error.key == "at" and cure in error.cure
    new, there, sentence = free_placement(scene_of(other), stand, spot, is_requested=False)
    assert words in sentence
    x, y = (int(v) for v in error.cure.split("[")[1].split("]")[0].split(","))
    named = unproject_spot(scene_of(other), LOW, new, (x, y), 1.0)  # the place that is named is where it is moved to
    assert np.linalg.norm(named.point - there.point) < 0.25


def test_an_object_that_fits_nowhere_is_refused_with_a_size_that_does():
    """The camera looks straight down on the ground."""
    spot = Spot(DOWN, DOWN.point, 20.0)
    error = refusal(
        "no free place in the picture: it would intersect 'there' and the camera",
        free_placement,
        scene_of(at(sphere(0.3), (0, 0, -5.7))),
        stand,
        spot,
        is_requested=False,
    )
    assert error.key == "size" and "of its size it fits at `at: [" in error.cure


# ── Mitsuba's scenes agree with the project's frames and reflectance model ──────────────────────────────────────────


pytest.importorskip("mitsuba")


def smooth_light(height):
    x, y, z = np.moveaxis(lat_long_directions(height, 2 * height), -1, 0)
    return 1 + np.stack([x * y, np.exp(4 * (0.6 * x + 0.8 * z - 1)) * 3, y * z * z], axis=-1)


def test_the_light_seen_is_the_light_there():
    """A map, seen from inside by six cameras in a turned frame, comes back as that map turned."""
    light = smooth_light(16)
    turn = tracing.look_rotation(20, 130) @ YUP_FROM_CAMERA
    seen = tracing.incident_light({"light": tracing.envmap(light)}, tracing.rigid(turn, (0, 0, 0)), 16, 4, 1)
    assert seen == pytest.approx(sample_map(light, lat_long_directions(16, 32) @ turn.T), rel=0.02, abs=0.05)
