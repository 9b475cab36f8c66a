"""What each pixel sees: normals, view directions, depth, material label and object, by Open3D's ray casting on the CPU.

Rays are cast in each mesh's own frame, moved to its centre and scaled to unit radius, so that a mesh in millimetres
far from its origin keeps single precision; a mesh's acceleration structure is built once and serves every pose.

Sides.  A face seen from behind is a face: the inside of an open shell, or a face that the file wound the wrong way.
Its normal is turned to the viewer and the pixel marked `back`.
Shading normals.  Interpolated normals near the contour can face away from the viewer though the face does not; they
are bent in the plane of normal and view to the nearest direction with n·v ≥ MIN_COSINE and marked `bent`.
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
MIN_COSINE = 0.01
NO_FACE = o3d.t.geometry.RaycastingScene.INVALID_ID


class Maps(msgspec.Struct, frozen=True):
    """Per pixel; 0 or False where no mesh is seen.

    normal  [h, w, 3] unit, shading, camera frame, facing the viewer      view  [h, w, 3] unit, toward the camera
    depth   [h, w] z in mesh units      label [h, w] int, mesh's material    object [h, w] int, from 1
    back    seen from behind            bent  the smooth normal faced away and was bent to face the viewer
    edge    cosine between face normal and view, 0..1
    facet   largest angle, in radians, between the face's normal and those of its corners: 0 on a flat face or a cut edge
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
    """First intersections of one mesh: depth (inf for none) and face (−1), barycentric uv of the 2nd and 3rd corner."""

    depth: Float[np.ndarray, "*n"]
    face: Int[np.ndarray, "*n"]
    uv: Float[np.ndarray, "*n 2"]


class Caster:
    """A mesh ready for rays; build once, use for any pose and camera."""

    def __init__(self, mesh: Mesh):
        self.mesh, self.centre, self.radius = mesh, mesh.centre, mesh.radius
        used = mesh.vertices[np.unique(mesh.faces)]
        self.corners = np.array(list(product(*zip(used.min(0), used.max(0)))))
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        vertices = ((mesh.vertices - self.centre) / self.radius).astype(np.float32)
        self.scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def cast(self, camera: Camera, pose: Pose) -> Hits:
        """Return what the rays through the pixel centres of `camera` meet first.  Rays beside the mesh's bounding box are not cast."""
        shape, window = (camera.height, camera.width), self._window(camera, pose)
        hits = Hits(np.full(shape, np.inf), np.full(shape, -1), np.zeros((*shape, 2)))
        part = self.cast_along(camera.rays(*window), pose)
        for name in hits.__struct_fields__:
            getattr(hits, name)[window] = getattr(part, name)
        return hits

    def _window(self, camera: Camera, pose: Pose) -> tuple[slice, slice]:
        """Rows and columns of the pixels that can show the mesh: of its bounding box, all where a corner is not before the camera."""
        corners = pose.apply(self.corners)
        if corners[:, 2].min() <= 0:
            return slice(0, camera.height), slice(0, camera.width)
        pixels = camera.project(corners)
        low, high = np.clip([pixels.min(0) - 1, pixels.max(0) + 2], 0, (camera.width, camera.height)).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def cast_along(self, directions: Float[np.ndarray, "*n 3"], pose: Pose) -> Hits:
        """Return what rays from the camera along `directions` (camera frame, z = 1, so that distance is depth) meet first."""
        rays = np.empty((*directions.shape[:-1], 6), np.float32)
        rays[..., :3] = (-pose.rotation.T @ pose.translation - self.centre) / self.radius
        rays[..., 3:] = directions @ (pose.rotation / self.radius)
        found = self.scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
        face = found["primitive_ids"].numpy()
        depth, uv = (found[name].numpy().astype(float) for name in ("t_hit", "primitive_uvs"))
        return Hits(depth, np.where(face == NO_FACE, -1, face.astype(np.int64)), uv)

    def labels(self, hits: Hits) -> Int[np.ndarray, "*n"]:
        """Material label of each hit, 0 for none."""
        return np.where(hits.face >= 0, self.mesh.face_label[hits.face], 0)


def rasterise(meshes: Mesh | Caster | Sequence, camera: Camera, poses: Pose | Sequence[Pose]) -> Maps:
    """Maps of one mesh or several, each at its pose (cam_from_object); the nearest wins."""
    solids = [meshes] if isinstance(meshes, (Mesh, Caster)) else meshes
    places = [poses] if isinstance(poses, Pose) else poses
    shape = camera.height, camera.width
    maps = Maps(
        np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape, np.int32),
        np.zeros(shape, np.int32), np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape), np.zeros(shape),
    )  # fmt: skip
    nearest, view = np.full(shape, np.inf), -unit(camera.rays())
    for number, (mesh, pose) in enumerate(zip(solids, places, strict=True), start=1):
        caster = mesh if isinstance(mesh, Caster) else Caster(mesh)
        hits = caster.cast(camera, pose)
        wins = (hits.face >= 0) & (hits.depth < nearest)
        nearest[wins] = hits.depth[wins]
        maps.depth[wins], maps.view[wins], maps.object[wins] = hits.depth[wins], view[wins], number
        mesh, face, seen_along = caster.mesh, hits.face[wins], view[wins]
        own = face_normals(mesh, face)
        facing = np.sum((own @ pose.rotation.T) * seen_along, axis=1)
        side = np.where(facing < 0, -1.0, 1.0)[:, None]
        smooth = unit(smooth_normals(mesh, face, hits.uv[wins]) @ pose.rotation.T) * side
        maps.normal[wins], maps.bent[wins] = toward_viewer(smooth, seen_along)
        maps.label[wins], maps.back[wins], maps.edge[wins] = mesh.face_label[face], facing < 0, np.abs(facing)
        cosines = np.abs(np.einsum("nkd,nd->nk", mesh.normals[mesh.faces[face]], own))
        maps.facet[wins] = np.arccos(np.minimum(cosines.min(1), 1.0))
    return maps


def toward_viewer(normal: Vectors, view: Vectors) -> tuple[Vectors, Bool[np.ndarray, " n"]]:
    """Normals bent, where n·v < MIN_COSINE, to n·v = MIN_COSINE in the plane of normal and view; and where that was."""
    cosine = np.sum(normal * view, axis=1)
    bent = cosine < MIN_COSINE
    across = unit(normal - cosine[:, None] * view)
    limit = np.sqrt(1 - MIN_COSINE**2) * across + MIN_COSINE * view
    return np.where(bent[:, None], limit, normal), bent


def smooth_normals(mesh: Mesh, face: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """The corners' normals of the triangles `face`, interpolated at barycentric uv; object frame, not of unit length."""
    u, v = uv.T
    return np.einsum("nk,nkd->nd", np.stack([1 - u - v, u, v], axis=1), mesh.normals[mesh.faces[face]])


def face_normals(mesh: Mesh, face: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of the triangles `face` of a mesh, by the winding of their corners, object frame."""
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    return unit(np.cross(b - a, c - a))


def unit(vectors: Vectors) -> Vectors:
    """Vectors of length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
