"""Subdivided mesh with vertices close enough together to carry detail, differential operators on it, and a solver.

Its vertices are those of the mesh and of its subdivision. Every edge longer than a threshold is halved. A triangle with
one, two or three such edges becomes two, three or four, so that neighbours agree along every edge and a closed mesh
stays closed. Vertices at one position are one node, on whichever side of a crease they are; nodes are numbered by
position.
"""

import logging

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, spsolve
from scipy.spatial import cKDTree

from factorlib.meshes.mesh import Mesh, area_vectors, weld_vertices

log = logging.getLogger("factorlib.meshes")
LONGEST = 0.04  # longest edge after subdivision, in units of the mesh's extent
LEVEL = 1e-3  # weight that keeps the mean displacement at zero, relative to the gradient's
THIN = 0.06  # greatest thickness of a thin part, in units of the extent; displacements are a third of it
OPPOSITE = -0.5  # largest cosine between normals of opposite sides
MOST_INWARD = 0.45  # largest displacement inward, in units of the thickness
UNSEEN = 0.05  # weight of the gradient where no photo sees the surface
MOST_ITERATIONS = 300  # of conjugate gradients


def subdivide(mesh: Mesh, longest: float) -> Mesh:
    """Subdivide the mesh until every edge is at most `longest` long, in units of the mesh.

    New vertices lie on the old triangles and have interpolated normals and detail.
    """
    detail = mesh.detail
    vertices = mesh.vertices
    normals = mesh.normals
    faces = mesh.faces.astype(np.int64)
    label = mesh.face_label
    while True:
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)  # edge k goes from corner k to the next
        too_long = np.linalg.norm(vertices[ends[..., 0]] - vertices[ends[..., 1]], axis=-1) > longest
        if not too_long.any():
            moved = {"vertices": vertices, "normals": normals, "detail": detail}
            return msgspec.structs.replace(mesh, faces=faces.astype(np.int32), face_label=label, **moved)
        # one new vertex at the midpoint of every long edge, with the mean normal of its ends
        pairs, number = np.unique(np.sort(ends[too_long], axis=1), axis=0, return_inverse=True)
        middle = np.full(faces.shape, -1)
        middle[too_long] = len(vertices) + number.reshape(-1)
        middle_normals = normals[pairs].sum(1)
        length = np.linalg.norm(middle_normals, axis=1, keepdims=True)
        middle_normals = np.where(length > 1e-9, middle_normals / np.maximum(length, 1e-9), normals[pairs[:, 0]])
        vertices = np.vstack([vertices, vertices[pairs].mean(1)])
        normals = np.vstack([normals, middle_normals])
        detail = None if detail is None else np.vstack([detail, detail[pairs].mean(1)])
        count = too_long.sum(1)
        parts = [faces[~too_long.any(1)]]
        labels = [label[~too_long.any(1)]]
        # rotate the corners of each triangle so that its long edges come first, then split it
        for long_edges, pieces in PIECES.items():
            selected = count == long_edges
            first = too_long[selected].argmax(1) if long_edges == 1 else (too_long[selected].argmin(1) + 1) % 3
            turn = (first[:, None] + np.arange(3)) % 3
            corners = np.hstack([np.take_along_axis(table[selected], turn, 1) for table in (faces, middle)])
            parts.append(corners[:, pieces].reshape(-1, 3))
            labels.append(np.repeat(label[selected], len(pieces)))
        faces = np.vstack(parts)
        label = np.concatenate(labels)


# Triangles that replace a triangle, by its number of long edges, which come first.
# 0 to 2 are its corners, 3 to 5 the midpoints of its edges.
PIECES = {
    1: [[0, 3, 2], [3, 1, 2]],
    2: [[3, 1, 4], [0, 3, 4], [0, 4, 2]],
    3: [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]],
}


class SubdividedMesh(msgspec.Struct, frozen=True):
    """Subdivided mesh and its v nodes.

    mesh    subdivided mesh, which may have several vertices at one position
    node    index of the node of each vertex
    faces   indices of the nodes at the corners
    extent  largest side of the bounding box, in mesh units
    """

    mesh: Mesh
    node: Int[np.ndarray, " n"]
    faces: Int[np.ndarray, "f 3"]
    extent: float

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return int(self.node.max()) + 1

    @property
    def edges(self) -> Int[np.ndarray, "e 2"]:
        """Pairs of neighbouring nodes, each once."""
        pairs = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)

    @property
    def areas(self) -> Float[np.ndarray, " f"]:
        """Areas of the triangles, in units of the squared extent."""
        return np.linalg.norm(area_vectors(self.mesh.vertices, self.mesh.faces), axis=1) / self.extent**2

    def laplacian(self) -> csr_array:
        """Return the graph Laplacian L with δᵀ L δ = Σ over edges of (δ_i − δ_j)², [v, v].

        In two dimensions this sum does not depend on the resolution of the mesh.
        """
        edges = self.edges
        number = np.arange(len(edges))
        signs = np.concatenate([np.ones(len(edges)), -np.ones(len(edges))])
        difference = csr_array((signs, (np.tile(number, 2), edges.T.reshape(-1))), (len(edges), self.nodes))
        return csr_array(difference.T @ difference)

    def gradients(self) -> list[csr_array]:
        """Return ∂/∂x, ∂/∂y and ∂/∂z on the surface for functions at nodes, [f, v] each.

        They are constant on each triangle; lengths are in units of the extent.
        """
        place = self.mesh.vertices[self.mesh.faces] / self.extent
        across = np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0])
        double = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        normal = across / double
        rows = np.repeat(np.arange(len(place)), 3)
        # gradient of the hat function of each corner: n × (opposite edge) / (2 · area)
        slopes = [np.cross(normal, place[:, (k + 2) % 3] - place[:, (k + 1) % 3]) / double for k in range(3)]
        shape = len(place), self.nodes
        values = np.stack(slopes, axis=1)  # [triangle, corner, axis]
        return [csr_array((values[..., a].reshape(-1), (rows, self.faces.reshape(-1))), shape) for a in range(3)]

    def normal_change(self, displacement: Float[np.ndarray, " v"]) -> Float[np.ndarray, "v 3"]:
        """Return −∇d at nodes, the change of normals by a displacement d in units of the extent."""
        # operator that averages over the triangles about each node, weighted by area, [v, f]
        count = len(self.faces)
        places = self.faces.reshape(-1), np.repeat(np.arange(count), 3)
        weight = csr_array((np.repeat(self.areas, 3), places), (self.nodes, count))
        mean = csr_array(diags_array(1 / np.maximum(np.asarray(weight.sum(1)).reshape(-1), 1e-300)) @ weight)
        return -np.stack([mean @ (slope @ displacement) for slope in self.gradients()], axis=1)

    def displacement(
        self, turn: Float[np.ndarray, "v 3"], node_weight: Float[np.ndarray, " v"]
    ) -> Float[np.ndarray, " v"]:
        """Fit the displacement along the normals whose normals n' = n − ∇d are nearest to the given ones.

        This is least squares over triangles, weighted by area (Poisson's equation). `turn` is n' − n at nodes, in the
        mesh's frame; `node_weight` is the weight of each node's turn, from 0 to 1. The result is in units of the
        extent.
        """
        slopes = self.gradients()
        areas = self.areas
        target = turn[self.faces].mean(1)
        weight = areas * np.maximum(node_weight[self.faces].min(1), UNSEEN)
        # normal equations Σ_a G_aᵀ W G_a d = −Σ_a G_aᵀ W t_a, with a small multiple of the identity
        system = sum(slope.T @ diags_array(weight) @ slope for slope in slopes)
        system = system + LEVEL * areas.mean() * eye_array(self.nodes)
        right = -sum(slope.T @ (weight * target[:, a]) for a, slope in enumerate(slopes))
        return spsolve(system.tocsc(), right)

    def displace(self, displacement: Float[np.ndarray, " v"]) -> Mesh:
        """Move the vertices along their nodes' normals, by `displacement` times the extent, and update the normals.

        Nodes of thin parts move inward by less than half of the thickness, so that two sides do not cross.
        """
        weighted = np.repeat(area_vectors(self.mesh.vertices, self.mesh.faces), 3, axis=0)
        sums = [np.bincount(self.faces.reshape(-1), column, self.nodes) for column in weighted.T]
        # area-weighted normals of the nodes
        outward = np.stack(sums, axis=1)
        outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
        step = np.maximum(displacement, -MOST_INWARD * self.thickness(outward)) * self.extent
        place = self.mesh.vertices + (step[:, None] * outward)[self.node]
        normal = self.mesh.normals + self.normal_change(displacement)[self.node]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        return msgspec.structs.replace(self.mesh, vertices=place, normals=normal)

    def thickness(self, outward: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
        """Return the distance behind each node of a nearby node on an opposite side, in units of the extent.

        It is infinite where the object is thicker than `THIN`.
        """
        place = np.zeros((self.nodes, 3))
        place[self.node] = self.mesh.vertices / self.extent
        pairs = cKDTree(place).query_pairs(THIN, output_type="ndarray")
        pairs = pairs[np.sum(outward[pairs[:, 0]] * outward[pairs[:, 1]], axis=1) < OPPOSITE]
        result = np.full(self.nodes, np.inf)
        for i, j in (pairs.T, pairs.T[::-1]):
            gap = np.sum((place[i] - place[j]) * outward[i], axis=1)
            np.minimum.at(result, i[gap > 0], gap[gap > 0])
        return result


def subdivided_mesh(mesh: Mesh, longest: float = LONGEST) -> SubdividedMesh:
    """Subdivide a mesh until no edge is longer than `longest` times its extent, and number its nodes."""
    extent = float(np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max())
    dense = subdivide(mesh, longest * extent)
    node = weld_vertices(dense.vertices)
    return SubdividedMesh(dense, node, node[dense.faces], extent)


def solve_by_gradients(
    system: LinearOperator | csr_array,
    target: Float[np.ndarray, " n"],
    diagonal: Float[np.ndarray, " n"],
    tolerance: float,
    start: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, " n"]:
    """Return the solution of a positive definite system; a warning says if it is not within the tolerance.

    Args:
        system: Matrix, or its product with a vector.
        target: Right-hand side.
        diagonal: Diagonal of the matrix, the preconditioner (Jacobi).
        tolerance: Largest residual, as a share of the right-hand side.
        start: First guess; None for 0.
    """
    inverse = diags_array(1 / diagonal)
    solution, status = cg(system, target, x0=start, rtol=tolerance, maxiter=MOST_ITERATIONS, M=inverse)
    if status:
        text = "conjugate gradients did not converge in %d iterations: the detail of %d unknowns is only approximate"
        log.warning(text, MOST_ITERATIONS, len(target))
    return solution
