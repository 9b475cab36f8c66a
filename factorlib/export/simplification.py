"""Meshes with few triangles: quadric error decimation (Garland and Heckbert 1997) that keeps the borders of materials.

Open3D's decimation keeps the border of an open mesh by planes across it, of any weight.  Every edge that must stay is
made such a border: a triangle that stands on it, a fin, is added before and removed after.  So both sides of a border
between materials keep the same vertices, and no gap opens.  Where the result is too far from the original surface, the
edges of the original about that place must stay as well, and it is made again.
"""

import logging

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.geometry import open3d as o3d
from factorlib.meshes.mesh import Mesh, area_vectors, weld_vertices

log = logging.getLogger("factorlib.export")
MOST_TRIANGLES = 20_000
MOST_ERROR = 1e-3  # largest distance between both surfaces, in units of the extent
ATTEMPTS = 8
# Weight of a fin's planes, and the quadric error (area × distance², extent 1) above which nothing collapses.  It is
# between that of moving the shortest kept edges, FIN_WEIGHT · 1e-11, and that of the largest error, 1e-4 · MOST_ERROR².
FIN_WEIGHT = 1e6
MOST_QUADRIC_ERROR = 1e-7
CREASE = 0.9  # cosine to the mean normal of a vertex, below which one of a corner is on another side of a crease
INSIDE = 0.05  # distance from a corner to where its normal is taken, as a share of that to the triangle's middle


class Surface:
    """Triangles that are asked for the point nearest to others."""

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]):
        self.faces = faces
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
        )

    def nearest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Return the nearest triangle, the barycentric coordinates of its nearest point, and the distance."""
        hit = self._scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
        face = hit["primitive_ids"].numpy().astype(np.int64)
        beta, gamma = hit["primitive_uvs"].numpy().astype(float).T
        distance = np.linalg.norm(hit["points"].numpy() - points, axis=1)
        return face, np.stack([1 - beta - gamma, beta, gamma], axis=1), distance


def simplify(mesh: Mesh) -> Mesh:
    """Return a mesh without detail and with at most MOST_TRIANGLES triangles; the mesh itself if it has no more.

    Edges between different labels stay.  No point of either surface is further than MOST_ERROR of the extent from the
    other.  A warning says if that takes more triangles.
    """
    if len(mesh.faces) <= MOST_TRIANGLES:
        return msgspec.structs.replace(mesh, detail=None)
    low = mesh.vertices.min(axis=0)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    node = weld_vertices(mesh.vertices)
    places = np.zeros((node.max() + 1, 3))
    places[node] = (mesh.vertices - low) / extent
    faces = node[mesh.faces]
    original = Surface(places, faces)
    kept = _label_borders(faces, mesh.face_label)
    for _ in range(ATTEMPTS):
        vertices, simplified = _decimate(places, faces, kept)
        middles = vertices[simplified].mean(axis=1)
        near, _, outward = original.nearest(middles)
        inward = Surface(vertices, simplified).nearest(places)[2]
        far = np.zeros(len(places), bool)
        far[inward > MOST_ERROR] = True
        far[faces[near[outward > MOST_ERROR]]] = True
        if not far.any():
            break
        kept = np.unique(np.vstack([kept, _edges(faces[far[faces].any(axis=1)])]), axis=0)
    if far.any() or len(simplified) > MOST_TRIANGLES:
        text = "a mesh of %d triangles is exported with %d, %.2g of its extent from the original at most"
        log.warning(text, len(faces), len(simplified), max(inward.max(), outward.max()))
    # normals of the original near each corner, inside of the triangle, which keeps creases
    corners = vertices[simplified]
    beside = corners + INSIDE * (middles[:, None] - corners)
    face, share, _ = original.nearest(beside.reshape(-1, 3))
    normals = np.einsum("nk,nkd->nd", share, mesh.normals[mesh.faces[face]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    # their mean at each vertex, unless it is on a crease
    corner = simplified.reshape(-1)
    mean = np.stack([np.bincount(corner, column) for column in normals.T], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    creased = np.bincount(corner, np.sum(mean[corner] * normals, axis=1) < CREASE) > 0
    normals = np.where(creased[corner, None], normals, mean[corner])
    # one vertex per position and normal
    key = np.column_stack([corner, np.round(normals * 2**10).astype(np.int64)])
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return Mesh(
        low + extent * corners.reshape(-1, 3)[first],
        index.reshape(-1, 3).astype(np.int32),
        normals[first],
        mesh.face_label[near],
        mesh.open,
    )


def _decimate(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], kept: Int[np.ndarray, "e 2"]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Return vertices and faces of the decimated mesh, whose extent is 1 and which has the `kept` edges still."""
    outward = np.zeros_like(vertices)
    np.add.at(outward, faces.T, area_vectors(vertices, faces))
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
    length = np.linalg.norm(vertices[kept[:, 0]] - vertices[kept[:, 1]], axis=1, keepdims=True)
    tips = vertices[kept].mean(axis=1) + length * outward[kept].mean(axis=1)
    fins = np.column_stack([kept, len(vertices) + np.arange(len(kept))])
    finned = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.vstack([vertices, tips])),
        o3d.utility.Vector3iVector(np.vstack([faces, fins]).astype(np.int32)),
    )
    result = finned.simplify_quadric_decimation(MOST_TRIANGLES + len(kept), MOST_QUADRIC_ERROR, FIN_WEIGHT)
    points = np.asarray(result.vertices)
    triangles = np.asarray(result.triangles)
    is_tip = np.isin(points.view("V24"), tips.view("V24")).reshape(-1)
    used, index = np.unique(triangles[~is_tip[triangles].any(axis=1)], return_inverse=True)
    return points[used], index.reshape(-1, 3)


def _edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Return the edges of each face, three a face, their ends ascending."""
    return np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)


def _label_borders(faces: Int[np.ndarray, "f 3"], label: Int[np.ndarray, " f"]) -> Int[np.ndarray, "e 2"]:
    """Return the edges between faces of different labels."""
    edges, number = np.unique(_edges(faces), axis=0, return_inverse=True)
    labels = np.repeat(label, 3)
    lowest = np.full(len(edges), label.max())
    highest = np.zeros_like(lowest)
    np.minimum.at(lowest, number.reshape(-1), labels)
    np.maximum.at(highest, number.reshape(-1), labels)
    return edges[lowest != highest]
