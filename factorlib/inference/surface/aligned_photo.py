"""Photo as `align` left it: its maps, its objects and their poses, and the surface points that its pixels show."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Int

from factorlib.dataset.schema import ObjectsSlice
from factorlib.images.exr import read_exr
from factorlib.inference.surface.surface_turns import Detail, SurfacePositions, Surfaces, attach_pixels
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read_mesh import MeshCache
from factorlib.results.poses import FILE as POSES
from factorlib.results.poses import PhotoPoses, read_poses
from factorlib.stage import Inputs
from factorlib.urm.extract import Channels


class AlignedPhoto(msgspec.Struct, frozen=True):
    """Photo as written by `align`: the file of its maps, its objects and their poses."""

    maps: Path
    objects: ObjectsSlice
    poses: PhotoPoses

    @property
    def geometry(self) -> Channels:
        """Maps of the photo, read from their file at every use: those of a hundred photos do not fit into memory."""
        return read_exr(self.maps)

    def attach(self, pixels: Int[np.ndarray, "n 2"], surfaces: Surfaces) -> SurfacePositions:
        """Return the positions of pixels (x, y) on the surfaces."""
        number = self.geometry["object"]
        height, width = number.shape
        objects = {entry.name: (entry.mesh, self.poses.objects[entry.name]) for entry in self.objects.objects}
        object_number = np.rint(number[pixels[:, 1], pixels[:, 0]]).astype(int)
        return attach_pixels(pixels, object_number, self.poses.camera.camera(width, height), objects, surfaces)

    def detail_channels(self, surfaces: Surfaces, detail: Detail) -> Channels:
        """Return normal.x, .y, .z (camera frame) and detail.R, .G, .B (factor on the diffuse reflectance).

        All are 0 at pixels without a mesh.
        """
        geometry = self.geometry
        y, x = np.nonzero(geometry["object"] > 0.5)
        normal, view = (
            np.stack([geometry[f"{kind}.{a}"][y, x] for a in "xyz"], axis=-1).astype(float)
            for kind in ("normal", "view")
        )
        attached = self.attach(np.column_stack([x, y]), surfaces)
        picture = np.zeros((*geometry["object"].shape, 6), np.float32)
        picture[y, x, :3] = attached.turn_normals(normal, view, detail.turn)
        picture[y, x, 3:] = attached.factor(detail.log_factor)
        names = [*(f"normal.{axis}" for axis in "xyz"), *(f"detail.{channel}" for channel in "RGB")]
        return dict(zip(names, np.moveaxis(picture, -1, 0)))


def read_aligned_photos(inputs: Inputs, slices: dict[str, ObjectsSlice]) -> dict[str, AlignedPhoto]:
    """Return all photos as written by `align`, sorted by name."""
    poses = read_poses(inputs["align"] / POSES)
    return {name: AlignedPhoto(inputs["align"] / f"{name}.exr", slices[name], poses[name]) for name in sorted(slices)}


def pixel_on_mesh(name: str, mesh: Mesh, photos: Mapping[str, AlignedPhoto]) -> float | None:
    """Return the width of a typical photo's pixel on a mesh, in units of its extent; None if no photo shows it."""
    extent = float(np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max())
    sizes = []
    for photo in photos.values():
        geometry = photo.geometry
        for number, entry in enumerate(photo.objects.objects, start=1):
            depth = geometry["depth"][np.rint(geometry["object"]) == number]
            if entry.mesh == name and len(depth):
                sizes.append(float(np.median(depth)) / photo.poses.camera.focal_px / extent)
    return float(np.median(sizes)) if sizes else None


def visible_meshes(read: MeshCache, slices: dict[str, ObjectsSlice]) -> dict[str, Mesh]:
    """Return the meshes that photos show, by name and sorted.

    Bodies of revolution that were estimated from outlines are left out, because their rotation about the axis is
    unknown.  Objects may give the parts of a mesh different materials; vertices do not depend on them.
    """
    meshes = {}
    for slice_ in slices.values():
        for entry in slice_.objects:
            if entry.mesh not in meshes and not slice_.meshes[entry.mesh].is_revolved:
                meshes[entry.mesh] = read.mesh(entry.mesh, slice_.meshes[entry.mesh], entry.materials)
    return dict(sorted(meshes.items()))
