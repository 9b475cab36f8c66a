"""Outline of an object in a photo, the input of shape estimation, and triangles, its result."""

from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt, map_coordinates

from factorlib.align.silhouette import ObjectView, Silhouette, bounding_box
from factorlib.geometry.camera import Camera, Pose
from factorlib.meshes.mesh import Mesh
from factorlib.wholefile import write_text

FREE = 1e9  # signed distance of places that the photo does not show, pixels: farther inside than any outline


class Outline(msgspec.Struct, frozen=True, dict=True):
    """Outline of an object in a photo, with the camera and, if it is known, the pose.

    part          [h, w] number of the object's part that a pixel shows, from 1; 0 background, −1 unknown
    camera        the photo's camera at its most probable focal length
    focal_sigma   standard deviation of the logarithm of the focal length, 0 if it is known
    pose          cam_from_object, if it is known
    """

    photo: str
    part: Int[np.ndarray, "h w"]
    camera: Camera
    focal_sigma: float = 0.0
    pose: Pose | None = None

    @property
    def view(self) -> ObjectView:
        """View of the object, with its parts as labels."""
        return ObjectView(Silhouette(self.part), self.camera, self.focal_sigma)

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """Centre (x, y) of the bounding box."""
        low, high, _ = bounding_box(self.view.silhouette)
        return (low + high) / 2

    @property
    def known_pose(self) -> Pose:
        """The pose; ValueError for an outline without one."""
        if self.pose is None:
            raise ValueError(f"the outline in '{self.photo}' has no pose")
        return self.pose

    @property
    def is_visible(self) -> bool:
        """True if the photo shows any part of the object."""
        return bool((self.part > 0).any())

    def inner(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Return the signed distance of points (x, y) to the outline in pixels, positive inside.

        Only background counts as outside: unknown pixels are inside. A point beyond the frame is outside if the nearest
        pixel of the frame is, at the sum of both distances; otherwise the value is FREE.
        """
        x, y = np.moveaxis(pixels, -1, 0)
        values = map_coordinates(self._distance, np.stack([y, x]) - 0.5, float, order=1, mode="nearest")
        height, width = self.part.shape
        beyond = np.hypot(np.maximum(np.maximum(-x, x - width), 0), np.maximum(np.maximum(-y, y - height), 0))
        return np.where(beyond == 0, values, np.where(values < 0, values - beyond, FREE))

    @cached_property
    def _distance(self) -> Float[np.ndarray, "h w"]:
        """Signed distance of each pixel to the background's border, positive inside; float32, for many photos."""
        empty = self.part == 0
        far = distance_transform_edt(~empty) if empty.any() else np.full(empty.shape, float(sum(empty.shape)))
        return np.where(empty, 0.5 - distance_transform_edt(empty), far - 0.5).astype(np.float32)


class Triangles(msgspec.Struct, frozen=True):
    """Shape as a triangle mesh: vertices [V, 3] in its own frame, faces [F, 3] counter-clockwise from outside.

    part      part of each face, from 0; None for a shape of one part
    overlap   mean IoU with the outlines of its fit
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " f"] | None = None
    overlap: float = 1.0

    def as_mesh(self) -> Mesh:
        """Return a mesh for rendering outlines: label 1 everywhere, with meaningless normals."""
        label = np.ones(len(self.faces), np.int16)
        return Mesh(self.vertices, self.faces.astype(np.int32), np.ones_like(self.vertices), label)

    def with_size(self, size: float) -> "Triangles":
        """Centre the bounding box at the origin and scale its longest side to `size`."""
        low = self.vertices.min(axis=0)
        high = self.vertices.max(axis=0)
        return msgspec.structs.replace(self, vertices=(self.vertices - (low + high) / 2) * (size / (high - low).max()))


def write_triangles(path: Path, shape: Triangles, parts: list[str]) -> None:
    """Write an OBJ file with a group for each part that has faces.

    Args:
        path: File to write.
        shape: The shape.
        parts: Names of its parts.
    """
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in shape.vertices.tolist()]
    for number, name in enumerate(parts):
        faces = shape.faces if shape.part is None else shape.faces[shape.part == number]
        if len(faces):
            lines += [f"g {name}", *(f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist())]
    write_text(path, "\n".join(lines) + "\n")
