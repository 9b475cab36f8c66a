"""Shapes of outlines (hulls, bodies of revolution, primitives), and cameras by structure from motion."""

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.generate.solids import SHAPES
from factorlib.geometry import open3d
from factorlib.geometry.camera import Camera, angle_between
from factorlib.shapes import motion
from factorlib.shapes.hull import hull_overlap, visual_hull
from factorlib.shapes.lathe import body_of_revolution
from factorlib.shapes.motion import LEAST_AGREEMENT, cameras_by_motion
from factorlib.shapes.outline import Triangles
from factorlib.shapes.primitive import primitive, unit_shape
from tests.refusal import refusal
from tests.shapes.outlines import looking_from, outline, views_of

AROUND = [
    looking_from(elevation, 30 * k) for k, elevation in enumerate([10, 20, -10, 30, 50, 0, 15, -25, 40, 5, -40, 25])
]
BLOB, VASE = SHAPES["blob"](), SHAPES["vase"]()


def solid(shape):
    return trimesh.Trimesh(shape.vertices, shape.faces, process=False)


def holds(shape, points):
    """The share of points that lie inside."""
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(shape.vertices.astype(np.float32), shape.faces.astype(np.uint32))
    return scene.compute_occupancy(points.astype(np.float32)).numpy().mean()


def test_a_hull_holds_the_body_and_looks_like_it_in_a_photo_it_was_not_made_of():
    hull = visual_hull([outline(BLOB, pose, True) for pose in AROUND], 64)
    assert solid(hull).is_watertight and hull.overlap > 0.985
    assert holds(hull, BLOB.vertices * 0.97) > 0.99
    assert 1.0 < solid(hull).volume / trimesh.Trimesh(BLOB.vertices, BLOB.faces).volume < 1.06
    new = looking_from(33, 47)
    visible, own = outline(hull.as_mesh(), new, True).part > 0, outline(BLOB, new, True).part > 0
    assert (visible & own).sum() / (visible | own).sum() > 0.97


@pytest.mark.parametrize("poses, said", [
    (AROUND[:1], "only one photo with a known camera shows it"), ([AROUND[0]] * 3, "from the same side"),
])  # fmt: skip
def test_a_hull_that_cannot_be_made_is_refused(poses, said):
    refusal(said, visual_hull, [outline(BLOB, pose, True) for pose in poses], 32)


def test_outlines_that_contradict_each_other_have_no_hull():
    wrong = msgspec.structs.replace(outline(BLOB, AROUND[3], True), pose=AROUND[9])
    beside = msgspec.structs.replace(wrong, part=np.roll(wrong.part, 150, axis=1))
    refusal("no body fits", visual_hull, [outline(BLOB, AROUND[0], True), beside, outline(BLOB, AROUND[6], True)], 48)


def profile(vertices, flip=False):
    """Radius by height, the heights 0 to 1."""
    height, radius = vertices[:, 1] * (-1 if flip else 1), np.hypot(vertices[:, 0], vertices[:, 2])
    order = np.argsort(height)
    return (height[order] - height.min()) / np.ptp(height), radius[order] / np.ptp(height)


@pytest.mark.long
def test_a_vase_by_lathe_has_the_vase_s_profile():
    shape = body_of_revolution([outline(VASE, looking_from(e, a), False) for e, a in ((5, 0), (45, 50))])
    assert shape.overlap > 0.98 and solid(shape).is_watertight and solid(shape).volume > 0
    assert np.ptp(shape.vertices, axis=0).max() == pytest.approx(1.0)
    heights = np.linspace(0.08, 0.92, 40)
    true = np.interp(heights, *profile(VASE.vertices))
    off = [np.abs(np.interp(heights, *profile(shape.vertices[:-2], flip)) / true - 1) for flip in (False, True)]
    assert min(each.mean() for each in off) < 0.05


def test_a_glint_that_a_mask_lacks_bores_no_hole_and_narrows_no_vase():
    whole = [outline(VASE, AROUND[k], True) for k in (1, 4)]
    part = whole[0].part.copy()
    x, y = whole[0].middle.astype(int)
    part[y - 6 : y + 6, x - 12 : x - 6] = 0
    shapes = [body_of_revolution([one, whole[1]]) for one in (whole[0], msgspec.structs.replace(whole[0], part=part))]
    assert np.array_equal(shapes[0].vertices, shapes[1].vertices)


@pytest.mark.long
def test_what_is_no_body_of_revolution_is_refused_or_overlaps_little():
    one = outline(BLOB, AROUND[3], False)
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    triangle = ((x > 60) & (y > 60) & (x - 60 + 1.7 * (y - 60) < 230)).astype(int)
    refusal("mirror-symmetric", body_of_revolution, [msgspec.structs.replace(one, part=triangle)])
    bent = trimesh.creation.box((1.0, 0.2, 0.2)) + trimesh.creation.box((0.2, 0.6, 0.2)).apply_translation(
        (0.4, 0.3, 0)
    )
    mesh = Triangles(np.asarray(bent.vertices), np.asarray(bent.faces)).as_mesh()
    assert body_of_revolution([outline(mesh, looking_from(20, 15), False)]).overlap < 0.9


@pytest.mark.parametrize(
    "kind, sides",
    [
        pytest.param("box", (1.0, 0.4, 0.7), marks=pytest.mark.long),
        pytest.param("cylinder", (1.0, 0.3, 1.0), marks=pytest.mark.long),
        ("ball", (1.0, 1.0, 1.0)),
    ],
)
def test_proportions_of_primitives_are_found(kind, sides):
    mesh = unit_shape(kind, np.array(sides)).as_mesh()
    poses, camera = (looking_from(25, 20), looking_from(40, 60)), Camera(96, 72, 120.0, (48.0, 36.0))
    shape = primitive(kind, [outline(mesh, pose, False, camera) for pose in poses])
    assert np.sort(np.ptp(shape.vertices, axis=0)) == pytest.approx(np.sort(sides), abs=0.02)
    assert shape.overlap > 0.97 and solid(shape).is_watertight and solid(shape).volume > 0


# ── Cameras by structure from motion: a body at rest, one that turns before a camera at rest, and photos that do not


RESTING = SHAPES["blob"]()
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


@pytest.mark.long
def test_cameras_about_a_body_at_rest_are_found_and_are_the_same_each_time():
    views, shares = views_of(RESTING, POSES, POSES), []
    result = cameras_by_motion(views, lambda share, what: shares.append(share))
    assert shares == sorted(shares) and len(set(shares)) > 2 * len(views)  # it moves with every photo, twice
    assert list(result) == list(views) and max(turns_off(result)) < 0.5
    assert all(each.focal == pytest.approx(1.3 * 320, rel=0.02) for each in result.values())
    known = msgspec.structs.replace(views["p0"].camera, focal=430.0)
    known_views = {name: msgspec.structs.replace(view, camera=known, focal_sigma=0.0) for name, view in views.items()}
    assert {each.focal for each in cameras_by_motion(known_views).values()} == {430.0}  # what is given is not moved
    again = cameras_by_motion(views, threads=1)
    assert all(np.array_equal(result[n].pose.rotation, again[n].pose.rotation) for n in result)


def test_cameras_by_chosen_pairs_are_right_and_the_same_for_any_number_of_threads(monkeypatch, caplog):
    """The last photo shows another thing: it is named, and left out."""
    views = views_of(RESTING, POSES[:4], POSES[:4], 240)
    noise = np.random.default_rng(1).integers(0, 255, (240, 240), np.uint8)
    views["p4"] = msgspec.structs.replace(views["p0"], grey=noise)
    monkeypatch.setattr(motion, "EXHAUSTIVE", 4)
    one, two = (cameras_by_motion(views, threads=threads) for threads in (1, 2))
    assert list(one) == list(two) == ["p0", "p1", "p2", "p3"] and "does not place p4" in caplog.text
    assert all(np.array_equal(one[n].pose.rotation, two[n].pose.rotation) for n in one)
    assert max(turns_off(one)) < 1.5  # a pixel is 0.2°


@pytest.mark.long
def test_of_a_body_that_turns_before_a_camera_at_rest_the_ground_that_stands_still_is_not_believed():
    result = cameras_by_motion(views_of(RESTING, POSES, [POSES[0]] * len(POSES), 480))
    assert len(result) >= 3 and max(turns_off(result)) < 3.0


def test_a_hull_agrees_with_its_masks_where_cameras_move_with_the_body_alone():
    bar = unit_shape("box", np.array([1.0, 0.3, 0.3])).as_mesh()
    moving = [outline(bar, pose, True) for pose in POSES]
    still = [msgspec.structs.replace(one, pose=POSES[0]) for one in moving]
    barely = [msgspec.structs.replace(one, pose=looking_from(20, 0.2 * k)) for k, one in enumerate(moving)]
    assert hull_overlap(moving) > 0.9 and hull_overlap(still) == 0.0  # all from the same side
    assert hull_overlap(barely) < LEAST_AGREEMENT


def test_photos_that_do_not_overlap_are_refused():
    apart = [looking_from(20, 90.0 * k) for k in range(4)]
    error = refusal(
        "of 4 photos can be registered",
        cameras_by_motion,
        views_of(RESTING, apart, [looking_from(20, 40 + 90.0 * k) for k in range(4)]),
    )
    assert "each 10 to 20° from the next" in error.cure
