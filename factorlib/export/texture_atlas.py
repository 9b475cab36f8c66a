"""Image textures of painted meshes: one atlas for all parts of a mesh, on a mesh of few triangles.

xatlas makes the charts and packs them.  It ends charts at every bump, so it is given a smoothed copy of the mesh, of
several the one with the fewest charts.  It takes faces for coplanar if each differs from the next by less than some
degrees, and so projects a finely divided sphere onto one plane or crashes, so the copy is roughened a little.  (UVAtlas
in Open3D makes fewer charts, but not the same ones twice.)  Charts do not end at borders of materials: the image has
the colour of each material on its own side.

Every texel gets the colour of the nearest point of the painted mesh, which is finer than the exported one.  Texture
coordinates (u, v) are right and up from the image's lower left corner, as in USD, Blender and PLY files.  Texels beyond
the borders of charts have the colour of the nearest texel within one, so that no lookup mixes in black.
"""

import logging
from collections.abc import Sequence

import msgspec
import numpy as np
import xatlas
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from factorlib.geometry import open3d as o3d
from factorlib.images.tone import srgb_encode
from factorlib.meshes.mesh import Mesh, area_vectors, weld_vertices
from factorlib.robust import TINY

# Meshes with few triangles: quadric error decimation (Garland and Heckbert 1997) that keeps the borders of materials.
#
# Open3D's decimation keeps the border of an open mesh by planes across it, of any weight.  Every edge that must stay is
# made such a border: a triangle that stands on it, a fin, is added before and removed after.  So both sides of a border
# between materials keep the same vertices, and no gap opens.  Where the result is too far from the original surface,
# the edges of the original about that place must stay as well, and it is made again.

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


GUTTER = 4  # least number of texels between charts
SMALLEST = 64  # least width and height of an image
LARGEST = 4096
SMOOTHING = (8, 10, 12, 14, 16)  # numbers of steps halfway to the mean of the neighbours
MOST_CHARTS = 60  # number of charts at which no further smoothing is tried
MOST_COST = 8.0  # of a chart of xatlas, whose default is 2
ROUGHNESS = 0.01  # standard deviation of the noise on xatlas's vertices, in units of the root of a triangle's mean area
LEAST_AREA = 1e-12  # least mean area of triangles, in units of the mesh's squared extent
UNKNOWN_PIXEL = 0.005  # width of a texel without a photo, in units of the mesh's extent
COVERED = 0.5  # share of an image that charts cover, as a first guess
COARSE = 0.95  # share of the surface on which texels are smaller than asked for


class Atlas(msgspec.Struct, frozen=True):
    """Exported mesh with texture coordinates, and the points of the painted mesh that its texels show.

    Attributes:
        mesh: exported mesh; label, detail and material are those of the painted mesh
        source: face of the painted mesh that is nearest to each exported face
        face: face of the painted mesh at each texel
        share: barycentric coordinates in it
    """

    mesh: Mesh
    source: Int[np.ndarray, " f"]
    face: Int[np.ndarray, "s s"]
    share: Float[np.ndarray, "s s 3"]

    def dress(self, painted: Mesh) -> Mesh:
        """Return the exported mesh with the labels of a painted mesh, which has the faces that the atlas is for."""
        return msgspec.structs.replace(self.mesh, face_label=painted.face_label[self.source])

    def bake(self, painted: Mesh, colours: Float[np.ndarray, "l 3"]) -> UInt8[np.ndarray, "s s 3"]:
        """Draw detail times colour as an sRGB image; products above 1 are written as 1.

        Args:
            painted: the painted mesh that the atlas is for, or one of other labels and detail
            colours: colour of each label, from 1
        """
        image = colours[painted.face_label[self.face] - 1]
        if painted.detail is not None:
            image = image * np.einsum("ijk,ijkc->ijc", self.share, painted.detail[painted.faces[self.face]])
        return np.rint(255 * srgb_encode(image.clip(0, 1))).astype(np.uint8)


def make_atlas(choices: Sequence[Mesh], painted: Mesh, pixel: float) -> Atlas:
    """Simplify a mesh, lay it out, and find the texels' places on the painted mesh.

    Args:
        choices: the mesh before it was subdivided for paint, with the labels of each choice of materials
        painted: the mesh that has the detail
        pixel: largest width of a texel on the surface, in units of the mesh
    """
    labels = np.unique([each.face_label for each in choices], axis=1, return_inverse=True)[1].reshape(-1)
    simple = simplify(msgspec.structs.replace(choices[0], face_label=(labels + 1).astype(np.int16)))
    area = float(np.linalg.norm(area_vectors(simple.vertices, simple.faces), axis=1).sum())
    mesh, texel, least = unwrap(simple, image_size((area / COVERED) ** 0.5 / pixel))
    size = max(image_size(texel / pixel), least)
    surface = Surface(painted.vertices, painted.faces)
    source = surface.nearest(mesh.vertices[mesh.faces].mean(axis=1))[0]
    places, nearest = _texel_places(mesh, size)
    face, share, _ = surface.nearest(places)
    return Atlas(mesh, source, face[nearest], share[nearest].astype(np.float32))


def image_size(texels: float) -> int:
    """Return the width and height of an image of at least so many texels across.

    >>> [image_size(texels) for texels in (3, 700.2, 1e5)]
    [64, 701, 4096]
    """
    return int(np.clip(np.ceil(texels), SMALLEST, LARGEST))


def unwrap(mesh: Mesh, size: int) -> tuple[Mesh, float, int]:
    """Return the mesh with texture coordinates, the image's side on the surface, and its least width with gutters.

    Vertices are repeated along the borders of charts.

    Args:
        mesh: the mesh
        size: about the width of the image, in texels
    """
    node = weld_vertices(mesh.vertices)
    low = mesh.vertices.min(axis=0)
    extent = float(np.ptp(mesh.vertices, axis=0).max()) or 1.0
    places = np.zeros((node.max() + 1, 3))
    places[node] = (mesh.vertices - low) / extent
    uv, least = _fewest_charts(places, node[mesh.faces], size)
    key = np.column_stack([mesh.faces.reshape(-1), uv.view(np.int32)])
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    vertex = mesh.faces.reshape(-1)[first]
    faces = index.reshape(-1, 3).astype(np.int32)
    result = Mesh(mesh.vertices[vertex], faces, mesh.normals[vertex], mesh.face_label, mesh.open, uv=uv[first])
    areas = [np.linalg.norm(area_vectors(points, faces), axis=1) for points in (result.vertices, _flat(result))]
    length = np.sqrt(areas[0] / np.maximum(areas[1], TINY))
    order = np.argsort(length)
    coarse = np.searchsorted(np.cumsum(areas[0][order]), COARSE * areas[0].sum())
    return result, float(length[order[coarse]]), least


def _flat(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Return the vertices in the image, at z = 0."""
    assert mesh.uv is not None
    return np.pad(mesh.uv.astype(float), [(0, 0), (0, 1)])


def _fewest_charts(
    places: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], size: int
) -> tuple[np.ndarray, int]:
    """Return texture coordinates at corners, float32 [3 f, 2], of the smoothing of fewest charts; and xatlas's width.

    Args:
        places: vertices, within the unit cube
        faces: triangles
        size: about the width of the image, in texels
    """
    # W averages over the neighbours of each vertex
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = np.unique(np.vstack([ends, ends[:, ::-1]]), axis=0)
    graph = csr_array((np.ones(len(ends)), ends.T), shape=(len(places),) * 2)
    average = csr_array(diags_array(1 / np.maximum(np.asarray(graph.sum(axis=1)).reshape(-1), 1)) @ graph)
    noise = np.random.default_rng(0).normal(0, ROUGHNESS, places.shape)
    fewest = len(faces) + MOST_CHARTS + 1
    piece = connected_components(graph, directed=False)[1]
    smooth = places
    for step in range(1, 1 + max(SMOOTHING)):
        smooth = (smooth + average @ smooth) / 2
        if step not in SMOOTHING or fewest <= MOST_CHARTS:
            continue
        bodies = _as_large(smooth, places, piece)
        area = np.linalg.norm(area_vectors(bodies, faces), axis=1).mean()
        atlas = xatlas.Atlas()
        atlas.add_mesh((bodies / max(area, LEAST_AREA) ** 0.5 + noise).astype(np.float32), faces.astype(np.uint32))
        charts = xatlas.ChartOptions()
        charts.max_cost = MOST_COST
        packing = xatlas.PackOptions()
        packing.resolution = size
        packing.padding = GUTTER
        atlas.generate(charts, packing)
        if atlas.chart_count < fewest:
            _, index, uv = atlas.get_mesh(0)
            fewest, width = atlas.chart_count, max(atlas.width, atlas.height)
            result = uv[index].reshape(-1, 2).astype(np.float32)
    return result, min(width, LARGEST)


def _as_large(
    smooth: Float[np.ndarray, "v 3"], places: Float[np.ndarray, "v 3"], piece: Int[np.ndarray, " v"]
) -> Float[np.ndarray, "v 3"]:
    """Return smoothed vertices with each connected piece as large as before: smoothing shrinks small ones to points.

    Args:
        smooth: vertices after smoothing
        places: vertices before it
        piece: number of each vertex's piece
    """
    count = np.bincount(piece)[:, None]
    offsets = [
        points - (np.column_stack([np.bincount(piece, column) for column in points.T]) / count)[piece]
        for points in (places, smooth)
    ]
    before, after = (np.bincount(piece, np.square(offset).sum(axis=1)) for offset in offsets)
    return places - offsets[0] + np.sqrt(before / np.maximum(after, TINY))[piece, None] * offsets[1]


def _texel_places(mesh: Mesh, size: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "s s"]]:
    """Return the places of the texels within charts, and the nearest one of these for every texel of the image."""
    # rays through the texels' centres hit the flat charts, and give the barycentric coordinates of the hits
    charts = o3d.t.geometry.RaycastingScene(nthreads=1)
    flat = (size * _flat(mesh)).astype(np.float32)
    charts.add_triangles(o3d.core.Tensor(flat), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rows, columns = np.indices((size, size), np.float32) + np.float32(0.5)
    rays = np.stack(np.broadcast_arrays(columns, size - rows, *np.array([1, 0, 0, -1], np.float32)), axis=-1)
    hits = charts.cast_rays(o3d.core.Tensor(rays))
    inside = np.isfinite(hits["t_hit"].numpy())
    beta, gamma = hits["primitive_uvs"].numpy()[inside].T[..., None]
    a, b, c = mesh.vertices[mesh.faces[hits["primitive_ids"].numpy()[inside]]].swapaxes(0, 1)
    number = np.cumsum(inside).reshape(size, size) - 1
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return (1 - beta - gamma) * a + beta * b + gamma * c, number[tuple(nearest)]
