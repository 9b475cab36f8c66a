"""Poses found from masks alone, against rendered truth: the mesh is exact, so the answer is too."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from factorlib.align.coarse import is_cut
from factorlib.align.search import Search, find, focal_prior
from factorlib.align.silhouette import UNKNOWN, Silhouette
from factorlib.geometry.camera import Pose, angle_between
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.read import usable
from factorlib.meshes.soup import Soup, no_normals
from tests.align.scenes import ball, blob, chair, dumbbell, mesh_of, normal_error_deg, photo_of, true_silhouette

KNOWN = "dataset"
QUICK = Search(views=160, rolls=16, keep=(20, 8, 4, 2))  # for what does not need the full search


def found_in(caster, camera, pose, silhouette=None, known_focal=False, mesh_given=None, search=QUICK):
    """What the search finds, and the median normal error in degrees."""
    silhouette = silhouette or true_silhouette(caster, camera, pose)
    prior = focal_prior(
        camera.focal if known_focal else None, KNOWN if known_focal else None, camera.width, camera.height
    )
    given = mesh_given or caster
    found = find(given, silhouette, camera, prior, search)
    return found, normal_error_deg(caster, camera, pose, found.state.camera(camera), found.state.pose(given))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_any_rotation_with_the_focal_length_unknown(seed):
    caster, camera, pose = photo_of([blob(), chair()][seed % 2], seed, focal=[0.9, 1.4, 2.2][seed], shift=(0.05, -0.04))
    found, error = found_in(caster, camera, pose, search=Search())
    assert error < 2 and found.score > 0.98
    assert abs(found.state.log_focal - np.log(camera.focal)) < max(3 * found.log_focal_sigma, 0.05)


def test_symmetric_shape_has_a_runner_up_that_looks_the_same():
    found, error = found_in(*photo_of(mesh_of([ball()]), 5), known_focal=True)
    assert error < 2 and found.runner_up.score > 0.97 and found.runner_up.normal_difference_deg < 3


def test_mask_cut_by_the_frame():
    caster, camera, pose = photo_of(chair(), 8, fill=1.0, shift=(0.28, 0.15))
    silhouette = true_silhouette(caster, camera, pose)
    assert is_cut(silhouette)
    assert found_in(caster, camera, pose, silhouette, known_focal=True)[1] < 2


def test_what_is_left_out_is_unknown_not_background():
    caster, camera, pose = photo_of(chair(), 9)
    label = true_silhouette(caster, camera, pose).label.copy()
    rows, columns = np.nonzero(label)
    label[:, int(np.quantile(columns, 0.7)) :] = UNKNOWN  # an occluder over nearly a third of it
    assert found_in(caster, camera, pose, Silhouette(label), known_focal=True)[1] < 2


def test_labels_settle_what_the_shape_cannot():
    """The photo shows the ends the other way round than the first mesh: the pose turns by half a turn."""
    caster, camera, pose = photo_of(dumbbell((1, 2)), 10)
    swapped = Caster(dumbbell((2, 1)))
    silhouette = true_silhouette(caster, camera, pose)
    found, error = found_in(caster, camera, pose, silhouette, known_focal=True)
    other, _ = found_in(caster, camera, pose, silhouette, known_focal=True, mesh_given=swapped)
    assert error < 2 and found.score > 0.97
    assert angle_between(found.state.rotation, other.state.rotation) > 60


def test_a_wrong_mesh_scores_lower():
    caster, camera, pose = photo_of(chair(), 11)
    silhouette, prior = true_silhouette(caster, camera, pose), focal_prior(camera.focal, KNOWN, 320, 240)
    assert (
        find(Caster(blob()), silhouette, camera, prior, QUICK).score
        < 0.8
        < 0.95
        < find(caster, silhouette, camera, prior, QUICK).score
    )


def test_millimetres_far_off_and_faces_flipped():
    caster, camera, pose = photo_of(blob(), 12)
    mesh, shift = caster.mesh, np.array([1e6, -2e6, 5e5])
    faces = mesh.faces.astype(np.int64)
    faces[::4] = faces[::4, ::-1]
    soup = Soup(mesh.vertices * 1000 + shift, faces, mesh.face_label * 0, [("all",)], no_normals(len(faces)))
    far = Caster(usable(soup, mesh.face_label, 40.0, "test"))
    found, _ = found_in(caster, camera, pose, known_focal=True, mesh_given=far)
    same = Pose(found.state.rotation, (found.state.pose(far).translation + found.state.rotation @ shift) / 1000)
    assert normal_error_deg(caster, camera, pose, camera, same) < 2


def test_a_tiny_mask_does_not_break_it():
    caster, camera, pose = photo_of(chair(), 13)
    label = np.zeros((240, 320), np.int16)
    label[100:104, 50:55] = 1
    found = find(caster, Silhouette(label), camera, focal_prior(None, None, 320, 240), QUICK)
    maps = rasterise(caster, found.state.camera(camera), found.state.pose(caster))
    rows, columns = np.nonzero(maps.label)
    assert 90 < rows.mean() < 114 and 40 < columns.mean() < 65


def test_the_same_twice():
    caster, camera, pose = photo_of(chair(), 14, width=160, height=120)
    first, second = found_in(caster, camera, pose)[0], found_in(caster, camera, pose)[0]
    assert np.array_equal(first.state.rotation, second.state.rotation)
    assert msgspec.structs.asdict(first.state)["log_focal"] == second.state.log_focal
