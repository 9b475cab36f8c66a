"""Poses found from masks alone and from keypoints, against rendered truth: right, where the mesh is exact, or said to be doubtful."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.align.coarse import is_cut
from factorlib.align.photo_alignment import Keypoints, KnownFocal, ObjectToAlign, align_photo
from factorlib.align.reliability import find_doubts, measure_reliability, mirrored_score, normal_stderr_deg
from factorlib.align.search import SearchOptions, estimate_pose
from factorlib.align.silhouette import UNKNOWN, Silhouette, label_agreement, silhouette_iou
from factorlib.align.state import pose_state
from factorlib.align.target import make_target
from factorlib.align.view import ObjectView, with_prior_focal
from factorlib.errors import InputError
from factorlib.geometry.camera import angle_between
from factorlib.geometry.raster import Caster, rasterise
from tests.align.scenes import ball, blob, chair, dumbbell, mesh_of, normal_error_deg, photo_of, true_silhouette

QUICK = SearchOptions(views=160, rolls=16, keep=(20, 8, 4, 2))  # for what does not need the full search
SMALL = {"width": 160, "height": 120}
BRIEF = SearchOptions(views=120, rolls=12, keep=(14, 6, 3, 2), steps=(5, 6, 8, 6))


def searched(mesh, seed, mask=None, given=None, known=True, search=QUICK, **how):
    """What the search finds of a photo of the mesh, and the median normal error in degrees; mask: of the true silhouette."""
    caster, camera, pose = photo_of(mesh, seed, **how)
    silhouette, given = true_silhouette(caster, camera, pose), given or caster
    silhouette = mask(silhouette) if mask else silhouette
    view = ObjectView(silhouette, *with_prior_focal(camera, camera.focal if known else None, "dataset"))
    found = estimate_pose(given, view, search, (shares := []).append)
    assert shares == sorted(set(shares)) and len(shares) == 5  # first guesses, and four rounds
    return found, normal_error_deg(caster, camera, pose, found.state.camera(camera), found.state.pose(given))


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


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_any_rotation_with_the_focal_length_unknown(seed):
    mesh, focal = [blob(), chair()][seed % 2], [0.9, 1.4, 2.2][seed]
    found, error = searched(mesh, seed, known=False, search=SearchOptions(), focal=focal, shift=(0.05, -0.04))
    assert error < 2 and found.score > 0.98
    assert abs(found.state.log_focal - np.log(focal * 320)) < max(3 * found.log_focal_sigma, 0.05)


def test_mask_cut_by_the_frame():
    how = {"seed": 8, "fill": 1.0, "shift": (0.28, 0.15)}
    assert is_cut(true_silhouette(*photo_of(chair(), **how)))
    assert searched(chair(), **how)[1] < 2


def test_what_is_left_out_is_unknown_not_background():
    def occluded(silhouette):  # by something over nearly a third of it
        label = silhouette.label.copy()
        label[:, int(np.quantile(np.nonzero(label)[1], 0.7)) :] = UNKNOWN
        return Silhouette(label)

    assert searched(chair(), 9, occluded)[1] < 2


def test_labels_settle_what_the_shape_cannot():
    """The photo shows the ends the other way round than the second mesh: the pose turns by half a turn."""
    found, error = searched(dumbbell((1, 2)), 10)
    other, _ = searched(dumbbell((1, 2)), 10, given=Caster(dumbbell((2, 1))), **SMALL)
    assert error < 2 and found.score > 0.97 and angle_between(found.state.rotation, other.state.rotation) > 60


def test_a_sphere_is_believed_though_its_turn_is_unknown():
    error, reasons, found = answered(mesh_of([ball()]), known=False)
    assert error < 2 and not reasons
    assert found.runner_up.score > 0.97 and found.runner_up.normal_difference_deg < 3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_flat_plate_is_right_or_doubted(seed):
    """From far away its outline does not tell whether it is tilted this way or that."""
    error, reasons, _ = answered(mesh_of([trimesh.creation.box((1.0, 0.7, 0.01))]), seed, known=False, **SMALL)
    assert error < 2 or reasons


def test_too_few_pixels_a_mask_of_the_whole_photo_and_a_mirrored_one_are_doubted():
    assert 10 <= true_silhouette(*photo_of(chair(), 21, fill=0.04)).inside.sum() <= 40
    assert any("tells normals" in reason for reason in answered(chair(), known=False, fill=0.04)[1])
    assert answered(chair(), mask=lambda s: Silhouette(np.ones_like(s.label)), known=False, **SMALL)[1]
    mirrored = answered(chair(), mask=lambda s: Silhouette(np.ascontiguousarray(s.label[:, ::-1])), known=False)
    assert any("mirror" in reason for reason in mirrored[1]) and not answered(chair(), known=False)[1]


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
    with pytest.raises(InputError, match=r"of the 8 keypoints of 'chair' agree") as caught:
        placed_by(caster, camera, keypoints, Silhouette(np.ones((240, 320), np.int16)), camera.focal)
    assert caught.value.key == "photo.chair.keypoints" and caught.value.cure


def seen(mesh, focal_sigma=0.0, **how):
    """The caster, a target of the mask, and the true state."""
    caster, camera, pose = photo_of(mesh, 1, **how)
    view = ObjectView(true_silhouette(caster, camera, pose), camera, focal_sigma)
    return caster, make_target(view, caster.mesh.labels, 200), pose_state(pose, camera, caster)


def test_fewer_pixels_and_an_unknown_focal_length_tell_normals_less_and_the_turn_of_a_ball_costs_nothing():
    stderr = [normal_stderr_deg(*seen(chair(), fill=fill, width=640, height=480)) for fill in (0.8, 0.2, 0.05)]
    assert stderr[0] < 1 and stderr[0] < stderr[1] < stderr[2] and stderr[2] > 3
    assert normal_stderr_deg(*seen(chair(), 0.5)) >= 0.99 * normal_stderr_deg(*seen(chair()))
    assert normal_stderr_deg(*seen(mesh_of([ball(subdivisions=5)]))) < 2


def test_the_mirror_image_of_a_photo_off_centre_scores_as_the_photo_did():
    caster, camera, pose = photo_of(chair(), 21, focal=1.0, shift=(0.1, 0.05))
    camera = msgspec.structs.replace(camera, centre=(camera.centre[0] - 12.0, camera.centre[1] + 3.0))
    silhouette = true_silhouette(caster, camera, pose)
    view = ObjectView(silhouette, camera)
    right, wrong = mirrored_score(caster, view.mirrored()), mirrored_score(caster, view)
    assert right > 0.98 and 1 - right < (1 - wrong) / 2
