"""A mesh with vertices close enough together to carry detail, and what lives on them: smoothness, gradients, displacements.

Vertices are those of the mesh itself and of its subdivision: every edge longer than a length is halved, and a triangle with one, two or three
such edges becomes two, three or four, so that neighbours agree along every edge and a closed mesh stays closed.  Vertices at one position are
one node, on whichever side of a crease they stand; nodes are numbered by position.
"""

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import spsolve

from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.normals import welded

LONGEST = 0.04  # of the mesh's extent: the longest edge after subdivision
LEVEL = 1e-3  # of the gradient's weight: what keeps the mean displacement at zero
UNSEEN = 0.05  # weight of the gradient where no photo sees the surface


def subdivided(mesh: Mesh, longest: float) -> Mesh:
    """The mesh with every edge at most `longest` long, in its units; new vertices lie on the old triangles, with interpolated normals."""
    vertices, normals, faces, label = mesh.vertices, mesh.normals, mesh.faces.astype(np.int64), mesh.face_label
    while True:
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)  # edge k goes from corner k to the next
        too_long = np.linalg.norm(vertices[ends[..., 0]] - vertices[ends[..., 1]], axis=-1) > longest
        if not too_long.any():
            return msgspec.structs.replace(
                mesh, vertices=vertices, normals=normals, faces=faces.astype(np.int32), face_label=label
            )
        pairs, number = np.unique(np.sort(ends[too_long], axis=1), axis=0, return_inverse=True)
        middle = np.full(faces.shape, -1)
        middle[too_long] = len(vertices) + number.reshape(-1)
        between = normals[pairs].sum(1)
        length = np.linalg.norm(between, axis=1, keepdims=True)
        between = np.where(length > 1e-9, between / np.maximum(length, 1e-9), normals[pairs[:, 0]])
        vertices, normals = np.vstack([vertices, vertices[pairs].mean(1)]), np.vstack([normals, between])
        count, parts, labels = too_long.sum(1), [faces[~too_long.any(1)]], [label[~too_long.any(1)]]
        for long_edges, pieces in PIECES.items():
            some = count == long_edges
            first = too_long[some].argmax(1) if long_edges == 1 else (too_long[some].argmin(1) + 1) % 3
            turn = (first[:, None] + np.arange(3)) % 3
            corners = np.hstack([np.take_along_axis(of[some], turn, 1) for of in (faces, middle)])
            parts.append(corners[:, pieces].reshape(-1, 3))
            labels.append(np.repeat(label[some], len(pieces)))
        faces, label = np.vstack(parts), np.concatenate(labels)


# By the number of long edges, which come first: the triangles that take a triangle's place; 0 to 2 its corners, 3 to 5 the middles of its edges.
PIECES = {
    1: [[0, 3, 2], [3, 1, 2]],
    2: [[3, 1, 4], [0, 3, 4], [0, 4, 2]],
    3: [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]],
}


class Fine(msgspec.Struct, frozen=True):
    """A subdivided mesh and its v nodes.

    mesh   its vertices may stand several times at one position;  node: the number of each vertex's node
    faces  corners as numbers of nodes;  extent: the largest side of the bounding box, in mesh units
    """

    mesh: Mesh
    node: Int[np.ndarray, " n"]
    faces: Int[np.ndarray, "f 3"]
    extent: float

    @property
    def nodes(self) -> int:
        """The number of nodes."""
        return int(self.node.max()) + 1

    @property
    def edges(self) -> Int[np.ndarray, "e 2"]:
        """Pairs of neighbouring nodes, each once."""
        pairs = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)

    @property
    def areas(self) -> Float[np.ndarray, " f"]:
        """Areas of the triangles, in squares of the extent."""
        return np.linalg.norm(area_vectors(self.mesh.vertices, self.mesh.faces), axis=1) / self.extent**2

    def laplacian(self) -> csr_array:
        """L with δᵀ L δ = Σ over edges of (δ_i − δ_j)², [v, v]; in two dimensions this does not depend on how fine the mesh is."""
        edges, number = self.edges, np.arange(len(self.edges))
        signs = np.concatenate([np.ones(len(edges)), -np.ones(len(edges))])
        difference = csr_array((signs, (np.tile(number, 2), edges.T.reshape(-1))), (len(edges), self.nodes))
        return csr_array(difference.T @ difference)

    def gradients(self) -> list[csr_array]:
        """∂/∂x, ∂/∂y and ∂/∂z on the surface of a function at nodes, constant on each triangle: [f, v] each, with lengths in extents."""
        place = self.mesh.vertices[self.mesh.faces] / self.extent
        across = np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0])
        double = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        normal, rows = across / double, np.repeat(np.arange(len(place)), 3)
        slopes = [np.cross(normal, place[:, (k + 2) % 3] - place[:, (k + 1) % 3]) / double for k in range(3)]
        shape = len(place), self.nodes
        values = np.stack(slopes, axis=1)  # by triangle, corner and axis
        return [csr_array((values[..., a].reshape(-1), (rows, self.faces.reshape(-1))), shape) for a in range(3)]

    def at_nodes(self) -> csr_array:
        """The mean over the triangles about each node, by area, [v, f]."""
        count = len(self.faces)
        places = self.faces.reshape(-1), np.repeat(np.arange(count), 3)
        weight = csr_array((np.repeat(self.areas, 3), places), (self.nodes, count))
        total = np.maximum(np.asarray(weight.sum(1)).reshape(-1), 1e-300)
        return csr_array(diags_array(1 / total) @ weight)

    def displacement(self, turn: Float[np.ndarray, "v 3"], seen: Float[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
        """The displacement along the normals, in extents, whose normals are turned as nearly as can be: n' = n − ∇d.

        turn: n' − n at nodes, in the mesh's frame;  seen: how much is known of each node's turn, 0 to 1
        Least squares over triangles, by area (Poisson's equation).
        """
        slopes, areas = self.gradients(), self.areas
        wanted = turn[self.faces].mean(1)
        weight = areas * np.maximum(seen[self.faces].min(1), UNSEEN)
        system = sum(slope.T @ diags_array(weight) @ slope for slope in slopes)
        system = system + LEVEL * areas.mean() * eye_array(self.nodes)
        right = -sum(slope.T @ (weight * wanted[:, a]) for a, slope in enumerate(slopes))
        return spsolve(system.tocsc(), right)

    def turn_of(self, displacement: Float[np.ndarray, " v"]) -> Float[np.ndarray, "v 3"]:
        """−∇d at nodes: how a displacement, in extents, turns normals."""
        mean = self.at_nodes()
        return -np.stack([mean @ (slope @ displacement) for slope in self.gradients()], axis=1)

    def moved(self, displacement: Float[np.ndarray, " v"]) -> Mesh:
        """The subdivided mesh with its vertices moved along their nodes' normals, in extents, and its normals turned with them."""
        weighted = area_vectors(self.mesh.vertices, self.mesh.faces)
        sums = [np.bincount(self.faces.reshape(-1), np.repeat(weighted[:, a], 3), self.nodes) for a in range(3)]
        outward = np.stack(sums, axis=1)
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
        place = self.mesh.vertices + (displacement[:, None] * self.extent * outward)[self.node]
        normal = self.mesh.normals + self.turn_of(displacement)[self.node]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        return msgspec.structs.replace(self.mesh, vertices=place, normals=normal)


def fine(mesh: Mesh) -> Fine:
    """The mesh, subdivided to `LONGEST` times its extent."""
    extent = float(np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max())
    dense = subdivided(mesh, LONGEST * extent)
    node = welded(dense.vertices)
    return Fine(dense, node, node[dense.faces], extent)
