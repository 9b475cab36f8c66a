"""Rasterisation of meshes by Open3D's ray casting on the CPU.

Each pixel gets a normal, a view direction, depth, material label and object.

Rays are cast in each mesh's own frame, moved to its centre and scaled to unit radius, so that a mesh in millimetres
far from its origin keeps single precision. A mesh's acceleration structure is built once and serves every pose.

Sides: A face seen from behind is rendered too: the inside of an open shell, or a face that the file wound the wrong
way. Its normal is flipped toward the viewer, and the pixel is marked `back`.
Shading normals: Near the contour, interpolated normals can face away from the viewer while the face does not. They are
bent in the plane of normal and view to the nearest direction with n·v ≥ MIN_COSINE, and marked `bent`.
"""

from collections.abc import Sequence
from itertools import product

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.geometry import open3d as o3d
from factorlib.geometry.camera import Camera, Pose
from factorlib.meshes.mesh import Mesh

Vectors = Float[np.ndarray, "*n 3"]
MIN_COSINE = 0.01  # least n·v of a shading normal
NO_FACE = o3d.t.geometry.RaycastingScene.INVALID_ID


class Maps(msgspec.Struct, frozen=True):
    """Rendered maps, 0 or False at pixels without a mesh.

    normal  [h, w, 3] unit, shading, camera frame, facing the viewer      view  [h, w, 3] unit, toward the camera
    depth   [h, w] z in mesh units      label [h, w] int, mesh's material    object [h, w] int, from 1
    back    seen from behind            bent  the smooth normal faced away and was bent to face the viewer
    edge    cosine between face normal and view, 0 to 1
    facet   largest angle, in radians, between the normals of the face and of its corners: 0 on a flat face or cut edge
    """

    normal: Float[np.ndarray, "h w 3"]
    view: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    label: Int[np.ndarray, "h w"]
    object: Int[np.ndarray, "h w"]
    back: Bool[np.ndarray, "h w"]
    bent: Bool[np.ndarray, "h w"]
    edge: Float[np.ndarray, "h w"]
    facet: Float[np.ndarray, "h w"]


class Hits(msgspec.Struct, frozen=True):
    """First intersections of rays with a mesh.

    depth  depth, inf for none
    face   number of the face, −1 for none
    uv     barycentric coordinates of the second and third corner
    """

    depth: Float[np.ndarray, "*n"]
    face: Int[np.ndarray, "*n"]
    uv: Float[np.ndarray, "*n 2"]


class Caster:
    """Mesh with an acceleration structure for rays; build it once, use it for any pose and camera."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self.centre = mesh.centre
        self.radius = mesh.radius
        used = mesh.vertices[np.unique(mesh.faces)]
        self.corners = np.array(list(product(*zip(used.min(0), used.max(0)))))
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        vertices = ((mesh.vertices - self.centre) / self.radius).astype(np.float32)
        self.scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def cast(self, camera: Camera, pose: Pose) -> Hits:
        """Return the first hits of the rays through the pixel centres of `camera`.

        Rays beside the mesh's bounding box are not cast.
        """
        shape = (camera.height, camera.width)
        window = self._window(camera, pose)
        hits = Hits(np.full(shape, np.inf), np.full(shape, -1), np.zeros((*shape, 2)))
        part = self.cast_along(camera.rays(*window), pose)
        for name in hits.__struct_fields__:
            getattr(hits, name)[window] = getattr(part, name)
        return hits

    def _window(self, camera: Camera, pose: Pose) -> tuple[slice, slice]:
        """Return rows and columns of the pixels that can show the mesh.

        These are the pixels of its bounding box, or all pixels if a corner of the box is behind the camera.
        """
        corners = pose.apply(self.corners)
        if corners[:, 2].min() <= 0:
            return slice(0, camera.height), slice(0, camera.width)
        pixels = camera.project(corners)
        low, high = np.clip([pixels.min(0) - 1, pixels.max(0) + 2], 0, (camera.width, camera.height)).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def cast_along(self, directions: Float[np.ndarray, "*n 3"], pose: Pose) -> Hits:
        """Return the first hits of rays from the camera along `directions`.

        The directions are in the camera frame with z = 1, so that distance is depth.
        """
        rays = np.empty((*directions.shape[:-1], 6), np.float32)
        rays[..., :3] = (-pose.rotation.T @ pose.translation - self.centre) / self.radius
        rays[..., 3:] = directions @ (pose.rotation / self.radius)
        hits = self.scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
        face = hits["primitive_ids"].numpy()
        depth, uv = (hits[name].numpy().astype(float) for name in ("t_hit", "primitive_uvs"))
        return Hits(depth, np.where(face == NO_FACE, -1, face.astype(np.int64)), uv)

    def labels(self, hits: Hits) -> Int[np.ndarray, "*n"]:
        """Return the material label of each hit, 0 for none."""
        return np.where(hits.face >= 0, self.mesh.face_label[hits.face], 0)


def rasterise(meshes: Mesh | Caster | Sequence, camera: Camera, poses: Pose | Sequence[Pose]) -> Maps:
    """Render the maps of one mesh or several, each at its pose; the nearest surface is visible.

    Args:
        meshes: Mesh or meshes.
        camera: Camera.
        poses: Pose of each mesh (cam_from_object).

    Returns:
        The maps.
    """
    solids = [meshes] if isinstance(meshes, (Mesh, Caster)) else meshes
    places = [poses] if isinstance(poses, Pose) else poses
    shape = camera.height, camera.width
    maps = Maps(
        normal=np.zeros((*shape, 3)),
        view=np.zeros((*shape, 3)),
        depth=np.zeros(shape),
        label=np.zeros(shape, np.int32),
        object=np.zeros(shape, np.int32),
        back=np.zeros(shape, bool),
        bent=np.zeros(shape, bool),
        edge=np.zeros(shape),
        facet=np.zeros(shape),
    )
    nearest = np.full(shape, np.inf)
    view = -unit(camera.rays())
    for number, (mesh, pose) in enumerate(zip(solids, places, strict=True), start=1):
        caster = mesh if isinstance(mesh, Caster) else Caster(mesh)
        hits = caster.cast(camera, pose)
        pixels = (hits.face >= 0) & (hits.depth < nearest)
        nearest[pixels] = hits.depth[pixels]
        maps.depth[pixels] = hits.depth[pixels]
        maps.view[pixels] = view[pixels]
        maps.object[pixels] = number
        _draw_surface(maps, pixels, caster.mesh, hits, pose.rotation)
    return maps


def _draw_surface(
    maps: Maps, pixels: Bool[np.ndarray, "h w"], mesh: Mesh, hits: Hits, rotation: Float[np.ndarray, "3 3"]
) -> None:
    """Fill in normals, labels and the measures of the faces that are visible at `pixels`.

    Args:
        maps: Maps, whose view directions are filled in.
        pixels: Pixels that show the mesh.
        mesh: The mesh.
        hits: Hits of the pixels' rays.
        rotation: Rotation cam_from_object.
    """
    face = hits.face[pixels]
    view = maps.view[pixels]
    flat = face_normals(mesh, face)
    facing = np.sum((flat @ rotation.T) * view, axis=1)
    # normals of the corners, interpolated by barycentric coordinates, on the viewer's side of the face
    u, v = hits.uv[pixels].T
    corner_normals = mesh.normals[mesh.faces[face]]
    smooth = np.einsum("nk,nkd->nd", np.stack([1 - u - v, u, v], axis=1), corner_normals)
    normal = unit(smooth @ rotation.T) * np.where(facing < 0, -1.0, 1.0)[:, None]
    # normals with n·v < MIN_COSINE are bent to n·v = MIN_COSINE, in the plane of normal and view
    cosine = np.sum(normal * view, axis=1)
    limit = np.sqrt(1 - MIN_COSINE**2) * unit(normal - cosine[:, None] * view) + MIN_COSINE * view
    maps.bent[pixels] = cosine < MIN_COSINE
    maps.normal[pixels] = np.where((cosine < MIN_COSINE)[:, None], limit, normal)
    maps.label[pixels] = mesh.face_label[face]
    maps.back[pixels] = facing < 0
    maps.edge[pixels] = np.abs(facing)
    # largest angle between the face's normal and those of its corners
    cosines = np.abs(np.einsum("nkd,nd->nk", corner_normals, flat))
    maps.facet[pixels] = np.arccos(np.minimum(cosines.min(1), 1.0))


def face_normals(mesh: Mesh, face: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the unit normals of the triangles `face`, by the winding of their corners, in the object frame."""
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    return unit(np.cross(b - a, c - a))


def unit(vectors: Vectors) -> Vectors:
    """Normalise vectors to length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
