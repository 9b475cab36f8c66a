"""What masks and meshes of real photographs do to a search: each is placed right, or said to be doubtful, or refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.align.doubts import Standards, doubts
from factorlib.align.place import KnownFocal, ObjectToPlace, placed
from factorlib.align.search import Search
from factorlib.align.silhouette import Silhouette, label_agreement, silhouette_iou
from factorlib.align.trust import trust_in
from factorlib.errors import InputError
from factorlib.generate.shapes import closed_grid
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.read import CREASE_DEG, read_mesh, usable
from factorlib.meshes.soup import Soup, no_normals
from tests.align.scenes import at, ball, blob, chair, mesh_of, photo_of, true_silhouette

QUICK = Search(views=120, rolls=12, keep=(14, 6, 3, 2), steps=(5, 6, 8, 6))


def answered(given: Caster, camera: Camera, silhouette: Silhouette, focal: float | None = None):
    """What the mesh shows at the pose found, and the doubts about it."""
    obj = ObjectToPlace("chair", given, silhouette)
    result = placed([obj], camera, KnownFocal(focal, "dataset" if focal else None), "photo", QUICK)
    seen = rasterise(given, result.camera, result.poses[0])
    iou, agreement = silhouette_iou(silhouette, seen.label), label_agreement(silhouette, seen.label)
    return seen, doubts(iou, agreement, trust_in(obj, result, 0), result.found[0])


def error_deg(truth, seen) -> float:
    cosine = np.clip(np.sum(truth.normal * seen.normal, axis=-1), -1, 1)
    return float(np.median(np.where(seen.label > 0, np.rad2deg(np.arccos(cosine)), 180.0)[truth.label > 0]))


def case(mesh, seed=21, **how):
    caster, camera, pose = photo_of(mesh, seed, **how)
    return caster, camera, rasterise(caster, camera, pose), true_silhouette(caster, camera, pose)


def damaged(mesh, how) -> Caster:
    """The mesh after `how` changed its vertices and faces, read as from a file."""
    vertices, faces = how(mesh.vertices.copy(), mesh.faces.astype(np.int64))
    soup = Soup(vertices, faces, np.zeros(len(faces), int), [("all",)], no_normals(len(faces)))
    return Caster(usable(soup, np.ones(len(faces), np.int16), CREASE_DEG, "test"))


def flipped(vertices, faces):
    faces[::3] = faces[::3, ::-1]
    return vertices, faces


def holed(vertices, faces):
    return vertices, np.delete(faces, np.s_[5 : len(faces) : 40], axis=0)


def duplicated(vertices, faces):
    """No face shares a vertex with another."""
    return vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def non_manifold(vertices, faces):
    """Fins inside the body: edges of three faces."""
    a, b, _ = faces[::50].T
    middle = len(vertices)
    return np.vstack([vertices, vertices.mean(axis=0)]), np.vstack(
        [faces, np.stack([a, b, np.full(len(a), middle)], axis=1)]
    )


def with_slivers(vertices, faces):
    """Faces of one point, of two points, and of three on a line."""
    n = len(vertices)
    vertices = np.vstack([vertices, vertices[0] + [[0.1, 0, 0], [0.2, 0, 0]]])
    return vertices, np.vstack([faces, [[0, 0, 0], [0, 1, 0], [0, n, n + 1]]])


def in_millimetres_far_off(vertices, faces):
    return 1000 * vertices + (4e6, -1e6, 2e6), faces


def z_up(vertices, faces):
    return vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), faces


@pytest.mark.parametrize("how", [flipped, holed, duplicated, non_manifold, with_slivers, in_millimetres_far_off, z_up])
def test_a_damaged_or_strange_mesh_shows_the_same_normals(how):
    caster, camera, truth, silhouette = case(blob())
    seen, reasons = answered(damaged(caster.mesh, how), camera, silhouette, camera.focal)
    assert error_deg(truth, seen) < 2 and not reasons


def test_a_vertex_that_is_no_number_is_refused_by_name(tmp_path):
    path = tmp_path / "nan.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv nan 1 0\nv 1 1 1\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(InputError, match=r"1 vertices are not finite, first is number 3"):
        read_mesh(path, ["white"], "white")


def test_a_million_triangles():
    phi, theta = np.meshgrid(np.arange(1000) / 1000 * 2 * np.pi, np.arange(1, 502) / 502 * np.pi)
    direction = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1)
    x, y, z = np.moveaxis(direction, -1, 0)
    radius = 1 + 0.25 * np.sin(3 * x + 1) + 0.2 * np.cos(2.5 * y - 0.4) * x + 0.3 * y * z + 0.25 * z**3
    mesh = closed_grid(direction * radius[..., None], np.array([0, 1.0, 0]), np.array([0, -1.0, 0]))
    assert len(mesh.faces) > 1_000_000
    caster, camera, truth, silhouette = case(mesh)
    seen, reasons = answered(caster, camera, silhouette, camera.focal)
    assert error_deg(truth, seen) < 2 and not reasons


def test_a_sphere_is_believed_though_its_turn_is_unknown():
    caster, camera, truth, silhouette = case(mesh_of([ball()]))
    seen, reasons = answered(caster, camera, silhouette)
    assert error_deg(truth, seen) < 2 and not reasons


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_flat_plate_is_right_or_doubted(seed):
    """From far away its outline does not tell whether it is tilted this way or that."""
    caster, camera, truth, silhouette = case(mesh_of([trimesh.creation.box((1.0, 0.7, 0.01))]), seed)
    seen, reasons = answered(caster, camera, silhouette)
    assert error_deg(truth, seen) < 2 or reasons


def test_twenty_pixels_are_too_few_and_it_is_said():
    caster, camera, truth, silhouette = case(chair(), fill=0.04)
    assert 10 <= silhouette.inside.sum() <= 40
    assert any("tells normals" in reason for reason in answered(caster, camera, silhouette)[1])


def test_a_mask_that_touches_all_four_edges_is_right_or_doubted():
    caster, camera, truth, silhouette = case(blob(), fill=2.6)
    rim = (silhouette.inside[0], silhouette.inside[-1], silhouette.inside[:, 0], silhouette.inside[:, -1])
    assert all(edge.any() for edge in rim)
    seen, reasons = answered(caster, camera, silhouette, camera.focal)
    assert error_deg(truth, seen) < 2 or reasons


def test_a_mask_of_the_whole_photo_is_doubted():
    caster, camera, *_ = case(chair())
    assert answered(caster, camera, Silhouette(np.ones((240, 320), np.int16)))[1]


def test_the_mirror_image_of_a_mask_is_found_out():
    caster, camera, _, silhouette = case(chair())
    mirrored = Silhouette(np.ascontiguousarray(silhouette.label[:, ::-1]))
    assert any("mirror" in reason for reason in answered(caster, camera, mirrored)[1])
    assert not answered(caster, camera, silhouette)[1]


def test_standards_are_what_doubts_are_measured_by():
    caster, camera, pose = photo_of(mesh_of([ball(), at(ball(0.5), 1.1, 0.3, 0)]), 4)
    moved = Pose(pose.rotation, pose.translation + np.array([0.02, 0, 0]))
    obj = ObjectToPlace("chair", caster, true_silhouette(caster, camera, pose), moved)
    result = placed([obj], camera, KnownFocal(camera.focal, "dataset"), "photo", QUICK)
    trust = trust_in(obj, result, 0)
    assert trust.normal_stderr_deg is None and trust.mirrored_score is None and trust.contour_error > 0
    below, above = (Standards(most_contour_error=trust.contour_error * factor) for factor in (0.9, 1.1))
    assert doubts(1.0, 1.0, trust, None, below) and not doubts(1.0, 1.0, trust, None, above)
    assert not doubts(1.0, 1.0, msgspec.structs.replace(trust, contour_error=0.0), None)
