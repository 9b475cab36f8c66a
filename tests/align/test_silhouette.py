"""What masks say of an object, how agreement is measured, and how far a normal is to be believed."""

from __future__ import annotations

import numpy as np
import pytest

from factorlib.align import silhouette as masks
from factorlib.align.coarse import is_cut
from factorlib.align.confidence import FACET, TURN, confidence, normal_spread
from factorlib.align.silhouette import UNKNOWN, Silhouette
from factorlib.align.target import make_target
from factorlib.align.view import ObjectView
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import rasterise
from tests.align.scenes import at, ball, dumbbell, mesh_of, photo_of, true_silhouette


def label_of(number, labels, own_mask, label, owner=None, left_out=None):
    """What the masks say of an object, or of the whole photo (number 0), in one row of pixels."""
    none = [0] * len(label)
    row = {"label": label, "object": owner or none, "left_out": left_out or none}
    row = {name: np.array([values], float) for name, values in row.items()}
    of = masks.silhouette_of_object(row, number, labels, own_mask) if number else masks.silhouette_of_photo(row)
    return of.label[0].tolist()


@pytest.mark.parametrize("of, expected", [
    ((0, (), False, [0, 1, 0], None, [0, 0, 1]), [0, 1, UNKNOWN]),  # what is left out
    ((1, (1, 3), False, [0, 1, 2, 3]), [0, 1, UNKNOWN, 3]),  # foreign materials may hide an object
    ((1, (1,), True, [0, 1, 1, 1], [0, 1, 2, 0]), [0, 1, UNKNOWN, UNKNOWN]),  # own masks part objects of one material
    ((2, (1,), False, [0, 1, 1, 1], [0, 1, 2, 0]), [0, UNKNOWN, 1, 1]),
])  # fmt: skip
def test_what_masks_say_of_an_object(of, expected):
    assert label_of(*of) == expected


def test_agreement_is_one_for_the_truth_and_ignores_the_unknown():
    caster, camera, pose = photo_of(dumbbell(), 3)
    silhouette, mesh_label = true_silhouette(caster, camera, pose), rasterise(caster, camera, pose).label
    label = silhouette.label.copy()
    label[:, 150:] = UNKNOWN
    measures = masks.silhouette_iou, masks.label_agreement, masks.labelled_iou
    for known in (silhouette, Silhouette(label)):
        assert [of(known, mesh_label) for of in measures] == [1, 1, 1]
    assert [of(silhouette, np.where(mesh_label > 0, 3 - mesh_label, 0)) for of in measures] == [1, 0, 0]


def test_cut_by_the_frame_or_a_broad_gap_but_not_by_a_thin_one():
    caster, camera, pose = photo_of(mesh_of([ball()]), 0)
    label = true_silhouette(caster, camera, pose).label
    thin, broad = label.copy(), label.copy()
    thin[120] = UNKNOWN
    rim = (label == 0) & (np.roll(label, 1, 1) | np.roll(label, -1, 1) > 0)
    thin[rim] = UNKNOWN
    broad[100:140] = UNKNOWN
    assert [is_cut(Silhouette(x)) for x in (label, thin, broad, label[:, 160:])] == [False, False, True, True]


def test_distance_to_a_straight_border_is_exact():
    label = np.zeros((20, 30), np.int16)
    label[5:15, 8:22] = 1
    view = ObjectView(Silhouette(label), Camera(30, 20, 1.0, (15.0, 10.0)))
    target = make_target(view, (1,), 1000, margin=0.35)
    region = target.regions[1]
    row, column = int(10 - target.top), int(8 - target.left)
    assert target.pixel == 1 and region.distance[row, column - 1 : column + 2].tolist() == [0.5, -0.5, -1.5]
    assert np.allclose(np.sort(np.unique(region.contour[:, 0]))[[0, -1]], [8 - target.left, 22 - target.left])
    assert np.allclose(region.outward[region.contour[:, 0] == 8 - target.left][3], (-1, 0))


def test_confidence_grows_from_contour_inward_and_is_zero_where_labels_differ():
    caster, camera, pose = photo_of(mesh_of([ball(), at(ball(0.6), 1.2, 0, 0)], [1, 2]), 6)
    maps = rasterise(caster, camera, pose)
    label = maps.label.astype(np.int16)
    sure = confidence(maps, Silhouette(label))
    assert sure.min() == 0 and 0.8 < sure.max() <= 1 and not sure[label == 0].any()
    row, column = (int(np.mean(k)) for k in np.nonzero(label == 1))
    assert sure[row, column] > 0.8
    wrong = label.copy()
    wrong[row - 3 : row + 3, column - 3 : column + 3] = 2
    assert confidence(maps, Silhouette(wrong))[row, column] == 0


def seen(mesh, seed, **photo):
    """The maps of a photo of the mesh, and the confidence in them."""
    maps = rasterise(*photo_of(mesh, seed, **photo))
    return maps, confidence(maps, Silhouette(maps.label.astype(np.int16)))


def test_confidence_falls_at_depth_jumps():
    caster, camera, pose = photo_of(mesh_of([at(ball(0.5), 0, 0, -2.0), ball()]), 6)
    maps = rasterise(caster, camera, type(pose)(np.eye(3), np.array([0, 0, pose.translation[2]])))
    sure = confidence(maps, Silhouette(maps.label.astype(np.int16)))
    inner = (np.abs(np.diff(maps.depth, axis=1)) > 0.3) & (maps.label[:, 1:] > 0) & (maps.label[:, :-1] > 0)
    assert inner.sum() > 20 and sure[:, 1:][inner].max() == 0


@pytest.mark.parametrize("height", [30, 60, 240])
def test_normals_turn_by_the_angle_that_a_pixel_spans_and_are_believed_less(height):
    fine = mesh_of([ball(subdivisions=5)], crease_deg=180.0)
    maps, sure = seen(fine, 3, width=2 * height, height=height, focal=40.0)
    middle, radius = (height // 2, height), 0.75 * height / 2  # pixels
    expected = np.sqrt(4 / 3) / radius  # of n = (x, y) / radius over 3 × 3 pixels
    assert normal_spread(maps)[middle] == pytest.approx(expected, rel=0.1)
    believed = 1 / (1 + (maps.facet[middle] / FACET) ** 2 + (expected / TURN) ** 2)
    assert sure[middle] == pytest.approx(believed, rel=0.02)
