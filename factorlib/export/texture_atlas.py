"""Image textures of painted meshes: charts that lay the surface out in a square, and images of colours at vertices.

xatlas makes the charts and packs them. It takes long on large charts, so their borders are limited. It takes faces for
coplanar if each differs from the next by less than some degrees, and so projects a finely divided sphere onto one plane
or crashes. So its copy of the mesh is roughened, and the faces are first divided by the axis that they face most.

Texture coordinates (u, v) are right and up from the image's lower left corner, as in USD, Blender and PLY files.
Texels beyond the borders of charts have the colour of the nearest texel within one, so that no lookup mixes in black.
"""

from functools import lru_cache

import numpy as np
import xatlas
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import distance_transform_edt

from factorlib.geometry import open3d as o3d
from factorlib.images.tone import srgb_encode
from factorlib.meshes.mesh import Mesh, area_vectors, weld_vertices

LONGEST_BORDER = 128  # longest border of a chart, in units of the square root of a triangle's mean area
GUTTER = 4  # least number of texels between charts
TEXELS_A_VERTEX = 16
SMALLEST = 256  # least width and height of an image
LARGEST = 4096
ROUGHNESS = 0.03  # standard deviation of the noise on xatlas's vertices, in the same unit
LEAST_AREA = 1e-12  # least mean area of triangles, in units of the mesh's squared extent
MOST_CHARTS_CACHED = 64  # number of parts: GLB files and scenes have the same ones


def unwrap(mesh: Mesh) -> Mesh:
    """Return the mesh with texture coordinates; its vertices are repeated along the borders of charts."""
    low = mesh.vertices.min(axis=0)
    extent = float(np.ptp(mesh.vertices, axis=0).max()) or 1.0
    place = ((mesh.vertices - low) / extent).astype(np.float32)
    origin, faces, uv = _charts(place.tobytes(), mesh.faces.astype(np.int32).tobytes())
    detail = None if mesh.detail is None else mesh.detail[origin]
    return Mesh(mesh.vertices[origin], faces, mesh.normals[origin], mesh.face_label, mesh.open, detail, uv)


def bake(mesh: Mesh, scale: Float[np.ndarray, "3"] | float = 1.0) -> UInt8[np.ndarray, "s s 3"]:
    """Draw the detail times a scale, interpolated linearly over the faces, as an sRGB image of the mesh's texture.

    Args:
        mesh: a mesh with detail and texture coordinates, from `unwrap`
        scale: factor per channel; products above 1 are written as 1
    """
    assert mesh.uv is not None and mesh.detail is not None
    colours = mesh.detail * scale
    size = texture_size(len(mesh.vertices))
    image = np.zeros((size, size, 3))
    covered = np.zeros((size, size), bool)
    # a chart may be narrower than a texel, so each vertex colours its texel first
    column, row = (size * np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]])).astype(int).clip(0, size - 1)
    image[row, column] = colours
    covered[row, column] = True
    # rays through the texels' centres hit the flat charts, and give the barycentric coordinates of the hits
    charts = o3d.t.geometry.RaycastingScene()
    flat = np.pad(size * mesh.uv, [(0, 0), (0, 1)]).astype(np.float32)
    charts.add_triangles(o3d.core.Tensor(flat), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rows, columns = np.indices((size, size), np.float32) + np.float32(0.5)
    rays = np.stack(np.broadcast_arrays(columns, size - rows, *np.array([1, 0, 0, -1], np.float32)), axis=-1)
    hits = charts.cast_rays(o3d.core.Tensor(rays))
    inside = np.isfinite(hits["t_hit"].numpy())
    beta, gamma = hits["primitive_uvs"].numpy()[inside].T[..., None]
    a, b, c = colours[mesh.faces[hits["primitive_ids"].numpy()[inside]]].swapaxes(0, 1)
    image[inside] = (1 - beta - gamma) * a + beta * b + gamma * c
    nearest = distance_transform_edt(~(covered | inside), return_distances=False, return_indices=True)
    return np.rint(255 * srgb_encode(image[tuple(nearest)].clip(0, 1))).astype(np.uint8)


def texture_size(vertices: int) -> int:
    """Return the width and height of the image for a number of vertices, a power of two.

    >>> [texture_size(count) for count in (3, 20_000, 200_000, 10_000_000)]
    [256, 1024, 2048, 4096]
    """
    least = max(SMALLEST, (TEXELS_A_VERTEX * vertices) ** 0.5)
    return min(LARGEST, 1 << int(np.ceil(np.log2(least))))


@lru_cache(maxsize=MOST_CHARTS_CACHED)
def _charts(
    vertices: bytes, faces: bytes
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "f 3"], Float[np.ndarray, "n 2"]]:
    """Return the source of each vertex of the unwrapped mesh, its faces, and its texture coordinates.

    Args:
        vertices: float32 coordinates, three a vertex, within the unit cube
        faces: int32 indices, three a face
    """
    places = np.frombuffer(vertices, np.float32).reshape(-1, 3)
    triangles = np.frombuffer(faces, np.int32).reshape(-1, 3)
    facing = area_vectors(places.astype(float), triangles)
    unit = max(float(np.linalg.norm(facing, axis=1).mean()), LEAST_AREA) ** 0.5
    noise = np.random.default_rng(0).normal(0, ROUGHNESS, places.shape)
    rough = (places / unit + noise[weld_vertices(places)]).astype(np.float32)
    side = np.hstack([facing, -facing]).argmax(axis=1)
    groups = [np.flatnonzero(side == axis) for axis in np.unique(side)]
    # a mesh of xatlas for each side, all packed into one atlas
    atlas = xatlas.Atlas()
    sources = []
    for group in groups:
        used, index = np.unique(triangles[group], return_inverse=True)
        sources.append(used)
        atlas.add_mesh(rough[used], index.reshape(-1, 3).astype(np.uint32))
    _generate(atlas, texture_size(len(places)) // 2)
    meshes = [atlas.get_mesh(number) for number in range(len(groups))]
    first = np.cumsum([0, *(len(vertex) for vertex, _, _ in meshes)])
    unwrapped = np.empty_like(triangles)
    for group, (_, index, _), start in zip(groups, meshes, first, strict=False):
        unwrapped[group] = index + start
    origin = np.concatenate([source[vertex] for source, (vertex, _, _) in zip(sources, meshes, strict=True)])
    return origin, unwrapped, np.concatenate([uv for _, _, uv in meshes]).astype(float)


def _generate(atlas: xatlas.Atlas, resolution: int) -> None:
    """Make and pack the charts; xatlas exceeds the resolution by up to nearly twice."""
    charts = xatlas.ChartOptions()
    charts.max_boundary_length = LONGEST_BORDER
    packing = xatlas.PackOptions()
    packing.resolution = resolution
    packing.padding = GUTTER
    atlas.generate(charts, packing)
