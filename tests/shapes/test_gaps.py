"""Gaps of masks: found by the other photos, named, and left out of the hull."""

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.generate.solids import SHAPES
from factorlib.shapes.gaps import mend_gaps
from factorlib.shapes.hull import visual_hull
from factorlib.shapes.outline import Triangles
from tests.shapes.outlines import looking_from, outline

AROUND = [looking_from(elevation, 45 * k) for k, elevation in enumerate([10, 40, -10, 30, 50, 0, 25, -25])]
AROUND = [msgspec.structs.replace(pose, translation=pose.translation * [1, 1, 0.5]) for pose in AROUND]  # closer
DAMAGES = {
    "gash": lambda x, y: abs(0.8 * x + 0.6 * y) < 14,
    "upright gash": lambda x, y: abs(x) < 16,
    "corner": lambda x, y: x + y < -60,
}


def photos(mesh):
    return [outline(mesh, pose, True, name=f"p{k}") for k, pose in enumerate(AROUND)]


@pytest.fixture(scope="module")
def blob():
    whole = photos(SHAPES["blob"]())
    return whole, volume(whole)


def volume(outlines):
    hull = visual_hull(outlines, 48)
    return trimesh.Trimesh(hull.vertices, hull.faces, process=False).volume


def damaged(one, damage):
    rows, columns = np.indices(one.part.shape)
    x, y = one.middle
    return msgspec.structs.replace(one, part=np.where(DAMAGES[damage](columns - x, rows - y), 0, one.part))


@pytest.mark.parametrize("damages", [
    {3: "gash"}, {1: "upright gash"}, {3: "corner"}, {1: "upright gash", 4: "gash"},
])  # fmt: skip
def test_what_masks_lack_is_named_and_the_hull_is_that_of_whole_masks(blob, damages):
    whole, true = blob
    cut = [damaged(one, damages[k]) if k in damages else one for k, one in enumerate(whole)]
    mended, gaps = mend_gaps(cut)
    assert [gap.photo for gap in gaps] == [f"p{k}" for k in damages]
    assert volume(cut) < 0.95 * true and volume(mended) == pytest.approx(true, rel=0.02)
    for k, gap in zip(damages, gaps, strict=True):
        lost = cut[k].part != whole[k].part
        assert (lost & (mended[k].part < 0)).sum() > 0.8 * lost.sum() and gap.witnesses >= 2
        assert (mended[k].part < 0).sum() == gap.pixels
    assert all(mended[k] is one for k, one in enumerate(cut) if k not in damages)


def test_a_cropped_photo_whose_mask_ends_just_before_the_border_cuts_nothing(blob):
    whole, true = blob
    one = whole[2]
    left = int(one.middle[0]) - 30
    part = one.part[:, left:].copy()
    part[:, :2] = 0
    camera = one.camera.window(left, 0, 1, part.shape[1], part.shape[0])
    cut = [*whole[:2], msgspec.structs.replace(one, part=part, camera=camera), *whole[3:]]
    mended, gaps = mend_gaps(cut)
    assert volume(cut) < 0.9 * true and volume(mended) == pytest.approx(true, rel=0.02)
    (gap,) = gaps
    assert gap.photo == "p2" and gap.x < 8


def test_a_thin_part_stays_where_one_mask_lacks_it_and_where_all_have_it():
    ball, rod = trimesh.creation.icosphere(3, 0.35), trimesh.creation.cylinder(0.05, 0.7)
    rod.apply_transform(trimesh.transformations.rotation_matrix(0.9, [1, 0.4, 0])).apply_translation([0.05, 0.3, 0.1])
    both = ball + rod
    whole = photos(Triangles(np.asarray(both.vertices), np.asarray(both.faces)).as_mesh())
    without = photos(Triangles(np.asarray(ball.vertices), np.asarray(ball.faces)).as_mesh())
    assert mend_gaps(whole)[1] == []
    mended, gaps = mend_gaps([*whole[:3], without[3], *whole[4:]])
    assert [gap.photo for gap in gaps] == ["p3"] and volume(mended) == pytest.approx(volume(whole), rel=0.02)


def test_whole_masks_stay_as_they_are_also_with_cameras_that_are_off_and_one_mask_that_holds_too_much(blob):
    whole = blob[0]
    shifts = np.random.default_rng(0).normal(0, 1, (len(whole), 2))
    off = [
        msgspec.structs.replace(
            one, camera=msgspec.structs.replace(one.camera, centre=tuple(one.camera.centre + shift))
        )
        for one, shift in zip(whole, shifts, strict=True)
    ]
    part = whole[5].part.copy()
    part[:, :150] = 1
    large = [*whole[:5], msgspec.structs.replace(whole[5], part=part), *whole[6:]]
    for outlines in (whole, off, large, whole[:3]):
        mended, gaps = mend_gaps(outlines)
        assert gaps == [] and all(a is b for a, b in zip(mended, outlines, strict=True))


def test_a_large_mask_has_the_gap_of_one_of_a_fraction_of_its_pixels(blob):
    """Masks are compared at most 400 pixels long."""
    whole = [
        msgspec.structs.replace(
            one, part=np.kron(one.part, np.ones((5, 5), int)), camera=one.camera.window(0, 0, 0.2, 1600, 1200)
        )
        for one in blob[0]
    ]
    rows, columns = np.indices(whole[1].part.shape)
    gash = abs(columns - whole[1].middle[0]) < 80
    whole[1] = msgspec.structs.replace(whole[1], part=np.where(gash, 0, whole[1].part))
    mended, (gap,) = mend_gaps(whole)
    assert gap.photo == "p1" and mended[1].part.shape == (1200, 1600)
    assert abs(gap.x - whole[1].middle[0]) < 20 and gap.pixels == (mended[1].part < 0).sum()
