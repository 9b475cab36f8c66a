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

from collections.abc import Sequence

import msgspec
import numpy as np
import xatlas
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from factorlib.export.simplification import Surface, simplify
from factorlib.geometry import open3d as o3d
from factorlib.images.tone import srgb_encode
from factorlib.meshes.mesh import Mesh, area_vectors, weld_vertices
from factorlib.robust import TINY

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
