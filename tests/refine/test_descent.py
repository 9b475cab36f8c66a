"""Shading moves a pose where the outline says nothing: by itself, if only the places of the light's lobes are known."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation

from factorlib.align.refine import FocalPrior
from factorlib.align.silhouette import UNKNOWN, Silhouette
from factorlib.align.state import state_of
from factorlib.refine import descent
from factorlib.refine.light import Surfaces, pursued_light
from factorlib.refine.pixels import View, pixels_of
from factorlib.reflection import reflection_operator
from studies.scenes.posed import KINDS, TRUE, normal_error, photographed

OPERATOR = reflection_operator("network")


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
