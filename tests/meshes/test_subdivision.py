"""Subdivided meshes: closed meshes stay closed, gradients are exact, and a displacement is found again from the turns that it means."""

import numpy as np
import pytest
import trimesh

from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.subdivision import SubdividedMesh, subdivide, subdivided_mesh


def mesh_of(solid: trimesh.Trimesh, factors=(1.0, 1.0, 1.0)) -> Mesh:
    """A trimesh with smooth normals of its own, two labels and stretched axes."""
    vertices = np.array(solid.vertices) * factors
    label = 1 + (np.arange(len(solid.faces)) % 3 == 0).astype(np.int16)
    normals = trimesh.Trimesh(vertices, solid.faces, process=False).vertex_normals
    return Mesh(vertices, np.array(solid.faces, np.int32), np.array(normals), label)


def ball(subdivisions: int = 2, factors=(1.0, 1.0, 1.0)) -> Mesh:
    """An icosphere of radius 1, its axes times `factors`."""
    return mesh_of(trimesh.creation.icosphere(subdivisions), factors)


SOLIDS = {
    "box": mesh_of(trimesh.creation.box((1, 0.3, 0.07))),
    "cone": mesh_of(trimesh.creation.cone(0.2, 1.0, sections=9)),
    "ball": ball(1),
}


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("longest", [0.5, 0.11, 0.05])
def test_a_closed_mesh_stays_closed_and_keeps_its_area_its_labels_and_its_winding(name, longest):
    mesh = SOLIDS[name]
    dense = subdivide(mesh, longest)
    ends = dense.vertices[np.stack([dense.faces, np.roll(dense.faces, -1, axis=1)])]
    assert np.linalg.norm(ends[0] - ends[1], axis=-1).max() <= longest
    edges = np.stack([dense.faces, np.roll(dense.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(
        edges
    )  # no edge twice in one direction: as closed and as wound as before
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    before, after = (area_vectors(of.vertices, of.faces) for of in (mesh, dense))
    for label in mesh.labels:  # vectors: areas, and directions too
        sums = [of[m.face_label == label].sum(0) for of, m in ((before, mesh), (after, dense))]
        areas = [np.linalg.norm(of[m.face_label == label], axis=1).sum() for of, m in ((before, mesh), (after, dense))]
        np.testing.assert_allclose(*sums, atol=1e-12)
        np.testing.assert_allclose(*areas)


def smooth(body: SubdividedMesh, size: float) -> np.ndarray:
    """A displacement of waves, of mean 0."""
    place = np.zeros((body.nodes, 3))
    place[body.node] = body.mesh.vertices / body.extent
    wave = size * np.sin(7 * place @ [1.0, 0.5, 0.2]) * np.cos(5 * place[:, 1])
    return wave - wave.mean()


def test_a_displacement_is_found_from_the_turns_that_it_means():
    body = subdivided_mesh(ball(3))
    true = smooth(body, 0.02)
    found = body.displacement(body.turn_of(true), np.ones(body.nodes))
    assert np.std(found - found.mean() - true) < 0.05 * np.std(true)


def test_a_ball_that_was_given_as_an_ellipsoid_gets_its_normals_back():
    given = ball(3, (1.0, 1.12, 0.9))
    body = subdivided_mesh(given)
    true = body.mesh.vertices / np.array([1.0, 1.12, 0.9])  # of the ball that each point stands for
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    turn = np.zeros((body.nodes, 3))
    turn[body.node] = true - body.mesh.normals
    moved = body.moved(body.displacement(turn, np.ones(body.nodes)))
    before, after = (
        np.degrees(np.arccos(np.clip(np.sum(n * true, 1), -1, 1))) for n in (body.mesh.normals, moved.normals)
    )
    assert np.median(after) < 0.25 * np.median(before)
    assert np.ptp(np.linalg.norm(moved.vertices, axis=1)) < 0.7 * np.ptp(np.linalg.norm(given.vertices, axis=1))
