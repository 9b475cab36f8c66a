"""Smooth normals: exact on a sphere, sharp at creases, indifferent to duplicates, winding and tessellation."""

from __future__ import annotations

import numpy as np
import trimesh

from factorlib.meshes.normals import consistently_wound, corner_normals
from factorlib.meshes.read import merged_normals, usable
from factorlib.meshes.triangle_soup import TriangleSoup, no_normals


def mesh_of(vertices, faces, normals=None, crease_deg=60.0):
    faces = np.asarray(faces)
    supplied = no_normals(len(faces)) if normals is None else normals
    soup = TriangleSoup(np.asarray(vertices, float), faces, np.zeros(len(faces), int), [("a",)], supplied)
    return usable(soup, np.ones(len(faces), int), crease_deg, "m")


def test_a_cube_is_sharp_or_rounded_by_the_crease_angle_and_angles_not_triangle_counts_weigh():
    box = trimesh.creation.box((1, 1, 1))
    sharp, smooth = mesh_of(box.vertices, box.faces), mesh_of(box.vertices, box.faces, crease_deg=100)
    assert len(sharp.vertices) == 24 and np.allclose(np.abs(sharp.normals).max(axis=1), 1)
    round_ = smooth.vertices / np.linalg.norm(smooth.vertices, axis=1, keepdims=True)
    assert len(smooth.vertices) == 8 and np.allclose(smooth.normals, round_)
    mesh = mesh_of(*trimesh.remesh.subdivide(box.vertices, box.faces, face_index=[0, 1]), crease_deg=100)
    corner = np.argmin(np.linalg.norm(mesh.vertices - 0.5, axis=1))  # of a side that is cut into many triangles
    assert np.allclose(mesh.normals[corner], 1 / np.sqrt(3))


def test_a_sphere_is_smooth_whether_its_triangles_share_vertices_or_not():
    ball = trimesh.creation.icosphere(subdivisions=3)
    soup = ball.triangles.reshape(-1, 3) + np.random.default_rng(0).normal(size=(len(ball.faces) * 3, 3)) * 1e-9
    split, shared = mesh_of(soup, np.arange(len(soup)).reshape(-1, 3)), mesh_of(ball.vertices, ball.faces)
    assert len(split.vertices) == len(shared.vertices) == len(ball.vertices)  # no crease: every vertex once
    assert np.rad2deg(np.arccos(np.sum(shared.normals * shared.vertices, axis=1).min())) < 0.6
    assert np.allclose(np.sort(split.normals @ [1, 2, 3]), np.sort(shared.normals @ [1, 2, 3]), atol=1e-6)


def test_flipped_faces_are_turned_back_unless_most_of_an_open_patch_is():
    ball = trimesh.creation.icosphere(subdivisions=2)
    faces = ball.faces.copy()
    faces[::3] = faces[::3, ::-1]
    for flipped in (faces, ball.faces[:, ::-1]):
        mesh = mesh_of(ball.vertices, flipped)
        assert np.sum(mesh.normals * mesh.vertices, axis=1).min() > 0.99
    bowl = ball.faces[ball.triangles_center[:, 2] > 0][:, ::-1]  # inward, on purpose
    flip, is_open = consistently_wound(ball.vertices, bowl)
    assert is_open and not flip.any()


def test_supplied_normals_are_used_where_sane():
    ball = trimesh.creation.icosphere(subdivisions=1)
    exact = ball.vertices[ball.faces]
    spoilt = exact.copy()
    spoilt[0], spoilt[1] = -exact[0], 0.0
    own = corner_normals(ball.vertices, ball.faces, 60.0)
    merged = merged_normals(own, spoilt, ball.face_normals)
    assert np.allclose(merged[2:], exact[2:]) and np.allclose(merged[:2], own[:2])
