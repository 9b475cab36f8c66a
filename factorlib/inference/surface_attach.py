"""Attachment of a photo's pixels to nodes of the subdivided meshes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int

from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster, face_normals
from factorlib.inference.surface_detail import Surfaces
from factorlib.inference.surface_turns import Attached
from factorlib.meshes.mesh import scaled
from factorlib.results.poses import ObjectPose


def attached_pixels(
    pixels: Int[np.ndarray, "n 2"],
    shown: Int[np.ndarray, " n"],
    camera: Camera,
    objects: Mapping[str, tuple[str, ObjectPose]],
    surfaces: Surfaces,
) -> Attached:
    """Return the nodes under pixels (x, y), in the camera's frame.

    Args:
        pixels: Integer pixel coordinates.
        shown: Object in each pixel, numbered from 1 as in `align`; 0 for none.
        camera: Camera of the photo.
        objects: Mesh name and pose of each object, in the order of their numbers.
        surfaces: Subdivided meshes; objects with other meshes are not attached.
    """
    along = camera.rays_through(pixels + 0.5)
    count = len(pixels)
    node = np.zeros((count, 3), np.int64)
    share = np.zeros((count, 3))
    frame = np.zeros((count, 3, 3))
    for number, (mesh, entry) in enumerate(objects.values(), start=1):
        if mesh not in surfaces.meshes:
            continue
        rows = np.flatnonzero(shown == number)
        fine = surfaces.meshes[mesh]
        scale = np.array(entry.scale)
        solid = scaled(fine.mesh, entry.scale)
        # first hits of the pixels' rays, their triangles and barycentric coordinates
        hits = Caster(solid).cast_along(along[rows], entry.pose)
        rows = rows[hits.face >= 0]
        face = hits.face[hits.face >= 0]
        uv = hits.uv[hits.face >= 0]
        node[rows] = surfaces.first[mesh] + fine.faces[face]
        share[rows] = np.column_stack([1 - uv.sum(1), uv])
        # R of (1) of `surface_turns`, with its sign changed where the surface is seen from behind
        toward = face_normals(solid, face) @ entry.pose.rotation.T
        side = np.where(np.sum(toward * along[rows], 1) > 0, -1.0, 1.0)
        frame[rows] = side[:, None, None] * entry.pose.rotation * (scale.mean() / scale)
    return Attached(node, share, frame)
