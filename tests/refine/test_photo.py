"""Poses in rendered photos: wrong ones come back, right ones stay, and what looks alike in outline shading tells apart."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from factorlib.align.refine import FocalPrior
from factorlib.align.silhouette import Silhouette
from factorlib.refine.light import Surfaces
from factorlib.refine.photo import PosedObject, Scene, refined_photo
from factorlib.refine.pixels import pixels_of
from factorlib.reflection import reflection_operator
from studies.scenes.posed import KINDS, TRUE, normal_error, photographed, refined_of

OPERATOR = reflection_operator("network")


def photo_of(kind, number, seed=0):
    return photographed(kind, number, np.random.default_rng([5, seed, KINDS.index(kind), number]), OPERATOR)


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
