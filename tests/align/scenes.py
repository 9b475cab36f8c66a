"""Meshes and photos of known pose for the tests of alignment."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from factorlib.align.silhouette import Silhouette
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.scenes.bodies import mesh_from_parts


def mesh_of(parts: list, labels: list[int] | None = None, crease_deg: float = 40.0) -> Mesh:
    """A mesh of trimesh parts, each with its label."""
    labels = labels or [1] * len(parts)
    shapes = [(part.vertices, part.faces, label) for part, label in zip(parts, labels, strict=True)]
    return mesh_from_parts(shapes, "test", crease_deg)


def at(part, *place):
    part.apply_translation(place)
    return part


def ball(radius=1.0, subdivisions=3):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def blob():
    """Smooth, without symmetry."""
    part = ball()
    x, y, z = part.vertices.T
    radius = 1 + 0.25 * np.sin(3 * x + 1) + 0.2 * np.cos(2.5 * y - 0.4) * x + 0.3 * y * z + 0.25 * z**3
    part.vertices = part.vertices * radius[:, None]
    return mesh_of([part])


def chair():
    """Seat, back, four legs and an arm on one side."""
    box = trimesh.creation.box
    seat = [box((1, 1, 0.1)), at(box((0.1, 1, 1)), -0.45, 0, 0.5), at(box((0.6, 0.08, 0.08)), 0, 0.45, 0.3)]
    legs = [at(box((0.08, 0.08, 0.9)), x, y, -0.5) for x in (-0.4, 0.4) for y in (-0.4, 0.4)]
    return mesh_of(seat + legs)


def dumbbell(labels=(1, 2)):
    """Mirror-symmetric in shape; only the labels tell one end from the other."""
    ends = [at(ball(0.6), -0.9, 0, 0), at(ball(0.6), 0.9, 0, 0)]
    return mesh_of([*ends, trimesh.creation.box((1.2, 0.3, 0.5))], [*labels, labels[0]])


def photo_of(mesh, seed, width=320, height=240, fill=0.75, focal=1.5, shift=(0.0, 0.0)) -> tuple[Caster, Camera, Pose]:
    """The mesh at a random rotation, its bounding sphere `fill` of the photo's height, moved by `shift` of its size."""
    caster = Caster(mesh)
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    camera = Camera(width, height, focal * width, (width / 2, height / 2))
    depth = 2 * camera.focal * caster.radius / (fill * height)
    middle = depth * np.array([shift[0] * width / camera.focal, shift[1] * height / camera.focal, 1.0])
    return caster, camera, Pose(rotation, middle - rotation @ caster.centre)


def true_silhouette(caster: Caster, camera: Camera, pose: Pose) -> Silhouette:
    return Silhouette(rasterise(caster, camera, pose).label.astype(np.int16))


def normal_error_deg(caster, camera, pose, found_camera, found_pose, given=None) -> float:
    """Median over the true silhouette; a pixel that the mesh given misses in the pose found counts as 180°."""
    truth, estimate = rasterise(caster, camera, pose), rasterise(given or caster, found_camera, found_pose)
    angle = np.rad2deg(np.arccos(np.clip(np.sum(truth.normal * estimate.normal, axis=-1), -1, 1)))
    return float(np.median(np.where(estimate.label > 0, angle, 180.0)[truth.label > 0]))
