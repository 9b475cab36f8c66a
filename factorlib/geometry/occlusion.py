"""Visibility of directions from surface points past the objects of a photo, by Open3D's ray casting on the CPU.

A ray leaves the surface a thousandth of its object's radius along the face's normal. The mesh stands for a smooth
surface. So a direction above the horizon of the shading normal, but below that of the flat face, is first bent up to
the latter. Then no convex mesh, however coarse, shadows itself. Directions below the shading normal's horizon are not
cast and count as visible; nothing is reflected from there.

If there are more than `most_points` points, an evenly spread subset is cast. The other points take the visibility of
the nearest cast point, near in position and in normal alike.

For a ray that is not free, the surface that it hits is recorded too, as a code of `factorlib.geometry.sphere`.
"""

from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from scipy.spatial import cKDTree

from factorlib.geometry import open3d as o3d
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, unit
from factorlib.geometry.sphere import NO_OCCLUDER, fibonacci_sphere, occluder_codes
from factorlib.meshes.mesh import Mesh, area_vectors

LIFT = 1e-3  # distance of a ray's origin from the surface, in units of the object's radius
GRAZING = 0.02  # sine of the least angle between a ray and its face
BELOW = -0.1  # least n·d of directions that are cast: normals that are averaged later may lean that far
ROWS = 256  # number of points whose rays are in memory at once, few enough for the processor's cache
Vectors = Float[np.ndarray, "n 3"]
Report = Callable[[int, int], None]
NORMAL_WEIGHT = 10.0  # a difference of 1 between normals counts as this many spacings of cast points


class SurfacePoints(msgspec.Struct, frozen=True):
    """Surface points under pixels: position and face normal (camera frame, facing the camera).

    valid: False for a pixel whose ray hits nothing
    """

    place: Float[np.ndarray, "n 3"]  # mesh units, lifted off the surface
    face_normal: Float[np.ndarray, "n 3"]
    valid: Bool[np.ndarray, " n"]


class Visibility(msgspec.Struct, frozen=True):
    """Visibility of k directions from n points.

    visibility  255 where a direction is free of the objects, 0 where not
    occluder    codes of the surfaces that are hit
    """

    visibility: UInt8[np.ndarray, "n k"]
    occluder: UInt16[np.ndarray, "n k"]


class Occluders(Caster):
    """Posed objects of one photo as one mesh, in the camera's frame."""

    def __init__(self, meshes: Sequence[Mesh], poses: Sequence[Pose]):
        """Join the meshes at their poses (cam_from_object); raise ValueError if there is no mesh."""
        vertices = [pose.apply(mesh.vertices) for mesh, pose in zip(meshes, poses, strict=True)]
        first = np.cumsum([0, *map(len, vertices)])
        faces = np.vstack([mesh.faces + start for mesh, start in zip(meshes, first, strict=False)])
        normals = np.vstack([mesh.normals for mesh in meshes])
        labels = [mesh.face_label for mesh in meshes]
        super().__init__(Mesh(np.vstack(vertices), faces, normals, np.concatenate(labels)))
        self.normal = unit(area_vectors(self.mesh.vertices, faces))  # face normals
        self.lift = LIFT * np.repeat([mesh.radius for mesh in meshes], [len(mesh.faces) for mesh in meshes])

    def points_under(self, camera: Camera, x: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"]) -> SurfacePoints:
        """Return the surface points that the rays through the centres of pixels (x, y) hit first.

        Args:
            camera: Camera.
            x: Columns of the pixels.
            y: Rows of the pixels.

        Returns:
            The points.
        """
        along = camera.rays_through(np.column_stack([x, y]) + 0.5)
        distance, face, is_back = self._first(self._rays(np.zeros_like(along), along))
        valid = np.isfinite(distance)
        depth = np.where(valid, distance * self.radius, 0.0)
        normal = self.hit_normals(face, is_back)
        return SurfacePoints(depth[:, None] * along + self.lift[face][:, None] * normal, normal, valid)

    def hit_normals(self, face: Int[np.ndarray, " n"], is_back: Bool[np.ndarray, " n"]) -> Vectors:
        """Return the normals of faces, flipped where the face is hit from behind."""
        return np.where(is_back[:, None], -self.normal[face], self.normal[face])

    def visibility_at(
        self,
        camera: Camera,
        pixels: Int[np.ndarray, "n 2"],
        shading_normal: Vectors,
        directions: int,
        most_points: int,
        report: Report = lambda done, total: None,
    ) -> Visibility | None:
        """Compute the visibility of the directions `fibonacci_sphere(directions)` from the points under pixels.

        Args:
            camera: Camera.
            pixels: Pixels (x, y).
            shading_normal: Unit shading normals of the pixels.
            directions: Number of directions.
            most_points: Greatest number of points to cast from, approximately.
            report: Called now and then with the number of finished points and their total.

        Returns:
            Visibility and codes; None if all directions are visible from all points.
        """
        x, y = pixels.T
        points = self.points_under(camera, x, y)
        subset = spread_subset(x, y, most_points)
        cast = SurfacePoints(*(getattr(points, name)[subset] for name in points.__struct_fields__))
        visibility = self.visibility_from(cast, shading_normal[subset], fibonacci_sphere(directions), report)
        if (visibility.visibility == 255).all():
            return None
        if len(subset) == len(x):
            return visibility
        # nearest cast point, in position (in units of their spacing) and in normal
        spacing = max(float(np.median(cKDTree(cast.place).query(cast.place, k=2)[0][:, 1])), 1e-12)
        places = np.column_stack([points.place / spacing, NORMAL_WEIGHT * shading_normal])
        nearest = cKDTree(places[subset]).query(places)[1]
        return Visibility(visibility.visibility[nearest], visibility.occluder[nearest])

    def visibility_from(
        self,
        points: SurfacePoints,
        shading_normal: Vectors,
        directions: Float[np.ndarray, "k 3"],
        report: Report = lambda done, total: None,
    ) -> Visibility:
        """Compute the visibility of directions from points.

        Args:
            points: Surface points.
            shading_normal: Unit shading normals of the points.
            directions: Unit directions, camera frame.
            report: Called with the number of finished points and their total.

        Returns:
            Visibility and codes of the hiding surfaces.
        """
        visibility = np.full((len(shading_normal), len(directions)), 255, np.uint8)
        occluder = np.full(visibility.shape, NO_OCCLUDER, np.uint16)
        material = self.mesh.face_label.astype(np.int64) - 1
        codes = np.array([[*occluder_codes(material, normal), NO_OCCLUDER] for normal in (self.normal, -self.normal)])
        for row, k, face, is_back in self.hidden_from(points, shading_normal, directions, report):
            visibility[row, k] = 0
            occluder[row, k] = codes[is_back.astype(int), face]
        return Visibility(visibility, occluder)

    def hidden_from(
        self,
        points: SurfacePoints,
        shading_normal: Vectors,
        directions: Float[np.ndarray, "k 3"],
        report: Report = lambda done, total: None,
    ) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield the pairs of a point and a direction that is hidden from it, in order of the points, in chunks.

        Args:
            points: Surface points.
            shading_normal: Unit shading normals of the points.
            directions: Unit directions, camera frame.
            report: Called with the number of finished points and their total.

        Yields:
            Arrays [n]: number of the point; number of the direction; number of the face that is hit, −1 if unknown;
            whether the face is hit from behind.
        """
        for i in range(0, len(shading_normal), ROWS):
            report(i, len(shading_normal))
            rows = slice(i, i + ROWS)
            row, k = np.nonzero((shading_normal[rows] @ directions.T > BELOW) & points.valid[rows, None])
            # bend directions below the face's horizon up to it
            normal = points.face_normal[rows]
            below = np.maximum(GRAZING - normal @ directions.T, 0)[row, k]
            rays = self._rays(points.place[rows][row], directions[k] + below[:, None] * normal[row])
            hidden = self.scene.test_occlusions(o3d.core.Tensor(rays), nthreads=1).numpy()
            distance, face, is_back = self._first(rays[hidden])
            yield i + row[hidden], k[hidden], np.where(np.isfinite(distance), face, -1), is_back

    def _first(self, rays: Float[np.ndarray, "n 6"]) -> tuple[np.ndarray, ...]:
        """Return the first hits of rays: distance in radii (inf for none), face, and whether it is hit from behind."""
        hits = self.scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
        distance = hits["t_hit"].numpy().astype(float)
        face = np.where(np.isfinite(distance), hits["primitive_ids"].numpy(), 0).astype(np.int64)
        return distance, face, np.sum(self.normal[face] * rays[:, 3:], 1) > 0

    def _rays(self, start: np.ndarray, along: np.ndarray) -> Float[np.ndarray, "n 6"]:
        """Return rays in the scene's frame; `along` keeps its length, so that distances are in units of the radius."""
        return np.hstack([(start - self.centre) / self.radius, along], dtype=np.float32, casting="same_kind")


def spread_subset(x: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], most: int) -> Int[np.ndarray, " m"]:
    """Select at most about `most` pixels: the first in each square of the picture.

    Args:
        x: Columns of the pixels.
        y: Rows of the pixels.
        most: Approximate limit of the number of pixels.

    Returns:
        Ascending indices of pixels.

    >>> y, x = np.divmod(np.arange(64), 8)
    >>> spread_subset(x, y, 16).tolist() == [8 * i + j for i in range(0, 8, 2) for j in range(0, 8, 2)]
    True
    """
    size = int(np.ceil(np.sqrt(len(x) / most)))
    return np.sort(np.unique(np.column_stack([y // size, x // size]), axis=0, return_index=True)[1])
