"""Poses from masks and keypoints against rendered truth and what masks say of objects."""

import numpy as np
import pytest
import trimesh

from factorlib.align import silhouette as masks
from factorlib.align.coarse import is_cut
from factorlib.align.photo_alignment import Keypoints, KnownFocal, ObjectToAlign, align_photo
from factorlib.align.refine import pose_state
from factorlib.align.reliability import confidence, find_doubts, measure_reliability, normal_stderr_deg
from factorlib.align.search import SearchOptions, estimate_pose
from factorlib.align.silhouette import (
    UNKNOWN,
    ObjectView,
    Silhouette,
    label_agreement,
    make_target,
    silhouette_iou,
    with_prior_focal,
)
from factorlib.geometry.camera import Camera, angle_between
from factorlib.geometry.raster import Caster, rasterise
from tests.align.scenes import at, ball, blob, chair, dumbbell, mesh_of, normal_error_deg, photo_of, true_silhouette
from tests.refusal import refusal

QUICK = SearchOptions(views=160, rolls=16, keep=(20, 8, 4, 2))  # for what does not need the full search
SMALL = {"width": 160, "height": 120}
BRIEF = SearchOptions(views=120, rolls=12, keep=(14, 6, 3, 2), steps=(5, 6, 8, 6))


def searched(mesh, seed, mask=None, given=None, known=True, search=QUICK, **how):
    """What the search finds of a photo of the mesh, and the median normal error in degrees; mask: of the true silhouette."""
    caster, camera, pose = photo_of(mesh, seed, **how)
    silhouette, given = true_silhouette(caster, camera, pose), given or caster
    silhouette = mask(silhouette) if mask else silhouette
    view = ObjectView(silhouette, *with_prior_focal(camera, camera.focal if known else None, "dataset"))
    estimate = estimate_pose(given, view, search, (shares := []).append)
    assert shares == sorted(set(shares)) and len(shares) == 5  # first guesses, and four rounds
    return estimate, normal_error_deg(caster, camera, pose, estimate.state.camera(camera), estimate.state.pose(given))


def answered(mesh, seed=21, mask=None, given=None, known=True, **how):
    """The median normal error of the pose that is placed, the doubts about it, and what was found."""
    caster, camera, pose = photo_of(mesh, seed, **how)
    silhouette, given = true_silhouette(caster, camera, pose), given or caster
    obj = ObjectToAlign("chair", given, mask(silhouette) if mask else silhouette)
    result = align_photo([obj], camera, KnownFocal(camera.focal, "dataset") if known else KnownFocal(), "photo", BRIEF)
    label = rasterise(given, result.camera, result.poses[0]).label
    iou, agreement = silhouette_iou(obj.silhouette, label), label_agreement(obj.silhouette, label)
    reasons = find_doubts(iou, agreement, measure_reliability(obj, result, 0), result.estimates[0])
    error = normal_error_deg(caster, camera, pose, result.camera, result.poses[0], given)
    return error, reasons, result.estimates[0]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_any_rotation_with_the_focal_length_unknown(seed):
    mesh, focal = [blob(), chair()][seed % 2], [0.9, 1.4, 2.2][seed]
    estimate, error = searched(mesh, seed, known=False, search=SearchOptions(), focal=focal, shift=(0.05, -0.04))
    assert error < 2 and estimate.score > 0.98
    assert abs(estimate.state.log_focal - np.log(focal * 320)) < max(3 * estimate.log_focal_sigma, 0.05)


def test_mask_cut_by_the_frame():
    how = {"seed": 8, "fill": 1.0, "shift": (0.28, 0.15)}
    assert is_cut(true_silhouette(*photo_of(chair(), **how)))
    assert searched(chair(), **how)[1] < 2


def test_what_is_left_out_is_unknown_not_background():
    def occluded(silhouette):  # by something over nearly a third of it
        label = silhouette.label.copy()
        label[:, int(np.quantile(np.nonzero(label)[1], 0.7)) :] = UNKNOWN
        return Silhouette(label)

    assert searched(chair(), 9, occluded, **SMALL)[1] < 2


def test_labels_settle_what_the_shape_cannot():
    """The photo shows the ends the other way round than the second mesh: the pose turns by half a turn."""
    estimate, error = searched(dumbbell((1, 2)), 10, **SMALL)
    other, _ = searched(dumbbell((1, 2)), 10, given=Caster(dumbbell((2, 1))), **SMALL)
    assert error < 2 and estimate.score > 0.97 and angle_between(estimate.state.rotation, other.state.rotation) > 60


def test_a_sphere_is_believed_though_its_turn_is_unknown():
    error, reasons, estimate = answered(mesh_of([ball()]), known=False)
    assert error < 2 and not reasons
    assert estimate.runner_up.score > 0.97 and estimate.runner_up.normal_difference_deg < 3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_flat_plate_is_right_or_doubted(seed):
    """From far away its outline does not tell whether it is tilted this way or that."""
    error, reasons, _ = answered(mesh_of([trimesh.creation.box((1.0, 0.7, 0.01))]), seed, known=False, **SMALL)
    assert error < 2 or reasons


@pytest.mark.long
def test_too_few_pixels_a_mask_of_the_whole_photo_are_doubted():
    assert 10 <= true_silhouette(*photo_of(chair(), 21, fill=0.04)).inside.sum() <= 40
    assert any("tells normals" in reason for reason in answered(chair(), known=False, fill=0.04)[1])
    assert answered(chair(), mask=lambda s: Silhouette(np.ones_like(s.label)), known=False, **SMALL)[1]
    assert not answered(chair(), known=False)[1]


TIPS = np.array([[-0.5, -0.5, 0.05], [0.5, -0.5, 0.05], [0.5, 0.5, 0.05], [-0.45, 0.5, 1.0], [-0.45, -0.5, 1.0], [0.4, 0.4, -0.95], [-0.4, -0.4, -0.95], [0.4, -0.4, -0.95]])  # fmt: skip


def named(camera, pose, off, seed) -> Keypoints:
    """The points where the camera sees them, each up to `off` pixels away from there."""
    shift = np.random.default_rng(seed).uniform(-off, off, (len(TIPS), 2))
    return Keypoints(camera.project(pose.apply(TIPS)) + shift, TIPS)


def placed_by(caster, camera, keypoints, silhouette, focal):
    obj = ObjectToAlign("chair", caster, silhouette, keypoints=keypoints)
    return align_photo([obj], camera, KnownFocal(focal, "dataset" if focal else None), "photo")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_careless_keypoints_and_the_mask_give_the_pose(seed, known):
    caster, camera, pose = photo_of(chair(), seed)
    keypoints, silhouette = named(camera, pose, off=2.0, seed=seed), true_silhouette(caster, camera, pose)
    result = placed_by(caster, camera, keypoints, silhouette, camera.focal if known else None)
    assert normal_error_deg(caster, camera, pose, result.camera, result.poses[0]) < 2
    assert result.estimates[0].source == "keypoints" and result.estimates[0].runner_up is None


def test_keypoints_that_do_not_agree_are_refused():
    caster, camera, _ = photo_of(chair(), 6)
    keypoints = Keypoints(np.random.default_rng(0).uniform(0, 240, (8, 2)), TIPS)
    caught = refusal(
        r"of the 8 keypoints of 'chair' agree",
        placed_by,
        caster,
        camera,
        keypoints,
        Silhouette(np.ones((240, 320), np.int16)),
        camera.focal,
    )
    assert caught.key == "photo.chair.keypoints"


def target_of(mesh, focal_sigma=0.0, **how):
    """The caster, a target of the mask, and the true state."""
    caster, camera, pose = photo_of(mesh, 1, **how)
    view = ObjectView(true_silhouette(caster, camera, pose), camera, focal_sigma)
    return caster, make_target(view, caster.mesh.labels, 200), pose_state(pose, camera, caster)


def test_fewer_pixels_and_an_unknown_focal_length_tell_normals_less_and_the_turn_of_a_ball_costs_nothing():
    stderr = [normal_stderr_deg(*target_of(chair(), fill=fill, width=640, height=480)) for fill in (0.8, 0.2, 0.05)]
    assert stderr[0] < 1 and stderr[0] < stderr[1] < stderr[2] and stderr[2] > 3
    assert normal_stderr_deg(*target_of(chair(), 0.5)) >= 0.99 * normal_stderr_deg(*target_of(chair()))
    assert normal_stderr_deg(*target_of(mesh_of([ball(subdivisions=5)]))) < 2


# ── What masks say of an object, how agreement is measured, and how far a normal is to be believed ──────────────────


@pytest.mark.parametrize("of, label, owner, left_out, expected", [
    ((), [0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 1, UNKNOWN]),  # what is left out
    ((1, (1, 3), False), [0, 1, 2, 3], [0] * 4, [0] * 4, [0, 1, UNKNOWN, 3]),  # foreign materials may hide an object
    ((1, (1,), True), [0, 1, 1, 1], [0, 1, 2, 0], [0] * 4, [0, 1, UNKNOWN, UNKNOWN]),  # own masks part objects of one material
    ((2, (1,), False), [0, 1, 1, 1], [0, 1, 2, 0], [0] * 4, [0, UNKNOWN, 1, 1]),
])  # fmt: skip
def test_what_masks_say_of_an_object_or_of_the_whole_photo_in_one_row_of_pixels(of, label, owner, left_out, expected):
    row = {"label": np.array([label]), "object": np.array([owner]), "left_out": np.array([left_out])}
    silhouette = masks.silhouette_of_object(row, *of) if of else masks.silhouette_of_photo(row)
    assert silhouette.label[0].tolist() == expected


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


def test_confidence_falls_at_depth_jumps():
    caster, camera, pose = photo_of(mesh_of([at(ball(0.5), 0, 0, -2.0), ball()]), 6)
    maps = rasterise(caster, camera, type(pose)(np.eye(3), np.array([0, 0, pose.translation[2]])))
    sure = confidence(maps, Silhouette(maps.label.astype(np.int16)))
    inner = (np.abs(np.diff(maps.depth, axis=1)) > 0.3) & (maps.label[:, 1:] > 0) & (maps.label[:, :-1] > 0)
    assert inner.sum() > 20 and sure[:, 1:][inner].max() == 0
