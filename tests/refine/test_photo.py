"""Poses in rendered photos: shading moves wrong ones, right ones stay, and what looks alike in outline shading tells apart."""

import msgspec
import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from factorlib.align.refine import FocalPrior
from factorlib.align.silhouette import UNKNOWN, Silhouette
from factorlib.align.state import state_of
from factorlib.refine import descent
from factorlib.refine.light import Surfaces, pursued_light
from factorlib.refine.photo import PosedObject, Scene, refined_photo
from factorlib.refine.pixels import View, pixels_of
from factorlib.reflection import reflection_operator
from studies.scenes.posed import KINDS, TRUE, normal_error, photographed, refined_of

OPERATOR = reflection_operator("network")


def photo_of(kind, number, seed=0):
    return photographed(kind, number, np.random.default_rng([5, seed, KINDS.index(kind), number]), OPERATOR)


def test_a_turned_pose_comes_back_and_its_silhouette_with_it():
    photo = photo_of("turned", 1)
    result = refined_of(photo, TRUE, OPERATOR)
    assert normal_error(photo, photo.pose) > 1.5 and result.settled.chosen == "moved"
    assert normal_error(photo, result.after.pose(photo.given)) < 0.5
    assert result.settled.candidates["moved"].score > result.settled.candidates["found"].score


def test_a_right_pose_stays_as_it_is():
    photo = photo_of("as found", 3)
    result = refined_of(photo, TRUE, OPERATOR)
    assert result.settled.chosen == "found" and np.array_equal(result.after.rotation, result.before.rotation)


@pytest.mark.parametrize("wrong_first", [True, pytest.param(False, marks=pytest.mark.long)])
def test_shading_tells_front_from_back_where_outlines_are_one(wrong_first):
    photo = photo_of("front/back", 0)
    first, second = (photo.pose, photo.runner_up) if wrong_first else (photo.runner_up, photo.pose)
    result = refined_of(msgspec.structs.replace(photo, pose=first, runner_up=second), TRUE, OPERATOR)
    scores = [c.score for c in result.settled.candidates.values()]
    assert max(scores) - min(scores) < 0.05 and normal_error(photo, photo.pose) > 20
    assert normal_error(photo, result.after.pose(photo.given)) < 1
    assert result.settled.chosen == "runner_up" if wrong_first else result.settled.ruled_out


def test_what_does_not_move_is_not_tried_and_no_pixels_change_nothing():
    photo = photo_of("turned", 1)
    own = PosedObject(photo.given, Silhouette(photo.channels["label"].astype(np.int16)), photo.pose, moves=False)
    scene = Scene(photo.camera, [own], FocalPrior(photo.camera.focal, 0.0))
    pixels = pixels_of(photo.channels, [True] * 3, 2400)
    for each in (refined_photo(scene, given, Surfaces(TRUE, OPERATOR)) for given in (pixels, None)):
        assert each[0].settled is None and np.array_equal(each[0].after.rotation, photo.pose.rotation)


def test_pixels_are_of_known_materials_and_held_out_by_whole_cells():
    photo = photo_of("as found", 1)
    label = photo.channels["label"]
    pixels = pixels_of(photo.channels, [True, False, True], 500)
    assert len(pixels) == 500 and set(pixels.material) == {2} and (label[pixels.y, pixels.x] == 3).all()
    for cell in np.unique(pixels.cell):
        assert len(set(pixels.held_out[pixels.cell == cell])) == 1
    assert 0.1 < pixels.held_out.mean() < 0.5 and pixels_of(photo.channels, [False] * 3, 500) is None
    clipped = {**photo.channels, "clipped.G": np.ones(label.shape)}
    assert (pixels_of(clipped, [True] * 3, 500).precision[:, 1] == 0).all()


# ── where the outline says nothing ────────────────────────────────────────────────────────────────────────────────────


def moved_by_shading(seed, monkeypatch):
    """Median error of normals before and after, in degrees, where a contour may lie anywhere near the outline at no cost."""
    photo = photographed("turned", 3, np.random.default_rng([5, seed, KINDS.index("turned"), 3]), OPERATOR)
    label = photo.channels["label"].astype(np.int16)
    about = binary_dilation(label > 0, iterations=20) & ~(label > 0)
    silhouette, prior = Silhouette(np.where(about, UNKNOWN, label)), FocalPrior(photo.camera.focal, 0.0)
    view = View(pixels_of(photo.channels, [True] * 3, 2400), [photo.given], [True])
    surfaces = Surfaces(TRUE, OPERATOR)
    moving = descent.moving_object(view, 0, photo.camera, silhouette, prior, [photo.pose], surfaces)
    start, true = (state_of(pose, photo.camera, photo.given) for pose in (photo.pose, photo.truth))
    block, agrees = moving.block(true, None)
    light = pursued_light(block.take(agrees), surfaces)
    with monkeypatch.context() as patch:
        patch.setattr(descent, "pursued_light", lambda *given: light)
        found = descent.descended(moving, start, steps=10, most_lost=0.05)
    return [normal_error(photo, state.pose(photo.given)) for state in (start, found)]


def test_where_the_outline_is_left_out_shading_finds_the_way_in_most_photos(monkeypatch):
    errors = np.array([moved_by_shading(seed, monkeypatch) for seed in range(4)])
    assert (errors[:, 0] > 1.5).all() and np.median(errors[:, 1] / errors[:, 0]) < 0.6
