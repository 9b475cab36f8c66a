"""What says how far a pose is to be believed follows the laws it is named for."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from factorlib.align.refine import FocalPrior
from factorlib.align.search import Search, find, focal_prior
from factorlib.align.silhouette import Silhouette, labelled_iou
from factorlib.align.state import state_of
from factorlib.align.target import target_of
from factorlib.align.trust import contour_error, mirrored_score, normal_stderr_deg
from tests.align.scenes import ball, blob, chair, mesh_of, photo_of, true_silhouette

KNOWN = FocalPrior(1.0, 0.0)


def seen(mesh, seed=1, **how):
    """The caster, the photo's camera, the true state, and a target of the mask."""
    caster, camera, pose = photo_of(mesh, seed, **how)
    return (
        caster,
        camera,
        state_of(pose, camera, caster),
        target_of(true_silhouette(caster, camera, pose), caster.mesh.labels, 200, 0.2),
    )


@pytest.mark.parametrize("larger", [0.04, -0.04, 0.1])
def test_a_ball_too_large_by_a_share_is_off_by_half_that_share_of_its_extent(larger):
    caster, camera, state, target = seen(mesh_of([ball(subdivisions=5)]), focal=8.0)
    nearer = msgspec.structs.replace(state, log_depth=state.log_depth - np.log(1 + larger))
    assert contour_error(caster, target, camera, state) < 0.002
    assert contour_error(caster, target, camera, nearer) == pytest.approx(abs(larger) / 2, abs=0.003)


def test_contour_error_is_the_same_at_any_size():
    errors = []
    for fill in (0.9, 0.3):
        caster, camera, state, target = seen(blob(), focal=20.0, fill=fill, width=640, height=480)
        errors.append(
            contour_error(caster, target, camera, msgspec.structs.replace(state, log_depth=state.log_depth - 0.1))
        )
    assert errors[0] == pytest.approx(errors[1], rel=0.1)


def test_fewer_pixels_tell_normals_less():
    stderr = []
    for fill in (0.8, 0.2, 0.05):
        caster, camera, state, target = seen(chair(), fill=fill, width=640, height=480)
        stderr.append(normal_stderr_deg(caster, target, camera, state, KNOWN))
    assert stderr[0] < 1 and stderr[0] < stderr[1] < stderr[2] and stderr[2] > 3


def test_an_unknown_focal_length_tells_no_more():
    caster, camera, state, target = seen(chair())
    free = normal_stderr_deg(caster, target, camera, state, FocalPrior(camera.focal, 0.5))
    assert free >= 0.99 * normal_stderr_deg(caster, target, camera, state, KNOWN)


def test_the_turn_of_a_ball_costs_nothing():
    caster, camera, state, target = seen(mesh_of([ball(subdivisions=5)]))
    assert normal_stderr_deg(caster, target, camera, state, KNOWN) < 2


def test_the_mirror_image_of_a_photo_off_centre_scores_as_the_photo_did():
    caster, camera, pose = photo_of(chair(), 21, focal=1.0, shift=(0.1, 0.05))
    camera = msgspec.structs.replace(camera, centre=(camera.centre[0] - 12.0, camera.centre[1] + 3.0))
    silhouette = true_silhouette(caster, camera, pose)
    flipped = Silhouette(np.ascontiguousarray(silhouette.label[:, ::-1]))
    centre = (camera.width - camera.centre[0], camera.centre[1])
    mirrored = msgspec.structs.replace(camera, centre=centre)
    prior = focal_prior(camera.focal, "dataset", camera.width, camera.height)
    right, wrong = mirrored_score(caster, flipped, mirrored, prior), mirrored_score(caster, silhouette, camera, prior)
    assert right > 0.98 and 1 - right < (1 - wrong) / 2


def test_winner_and_runner_up_are_scored_in_the_same_window():
    caster, camera, pose = photo_of(chair(), 3, width=640, height=480)
    silhouette, search = true_silhouette(caster, camera, pose), Search(views=120, rolls=12, keep=(14, 6, 3, 1))
    found = find(caster, silhouette, camera, focal_prior(camera.focal, "dataset", 640, 480), search)
    target = target_of(silhouette, caster.mesh.labels, search.resolution[-1], search.margin[-1])
    for one in (found, found.runner_up):
        hits = caster.cast(target.camera(one.state.camera(camera)), one.state.pose(caster))
        assert one.score == labelled_iou(target.silhouette, caster.labels(hits))
