"""Objects on the ground plane of a photo, which dataset.yaml gives, or on which an object rests or stands.

Where the dataset has an upright world, the ground is level in it, within the error of its horizon.

Objects on a grey floor, which receives their shadow and fades out around them, are w L₁ + (1 − w) L₀, w = max(W, f).
L₁ and L₀ are path-traced with the floor and without it.  W is the share of a pixel that objects fill.  f falls from 1
beneath the objects to 0 at `REACH` of their size.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from factorlib.errors import InputError
from factorlib.geometry.ground import Plane, resting_plane
from factorlib.render.photo_scene import PhotoScene, PlacedMesh, traced_photo
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import bsdf, rigid, transform

REACH = 3.0  # radius of a floor, in half extents of the objects
SOLID = 0.3  # share of the radius within which the floor does not fade
LEVEL_DEG = 5.0  # error of a world's horizon: cameras roll by about 3° (`factorlib.dataset.sources.external_cameras`)
HAIR = 3e-5  # depth of the floor below the plane, in its radii: surfaces must not touch


def level_ground(placed: PlacedMesh, up: Float[np.ndarray, "3"]) -> tuple[Plane, str]:
    """Return the plane below an object in an upright world, and how it was decided.

    It is that of the object's likeliest stable pose within LEVEL_DEG of upright.  If there is none, as for many a rough
    hull, it is level and touches the object's lowest point.

    Args:
        placed: the object
        up: unit upright direction, in the world
    """
    rotation = placed.rotation
    plane = resting_plane(placed.mesh.vertices, placed.vertices, rotation, (rotation.T @ up)[None], LEVEL_DEG)
    if plane is not None:
        return plane, f"where '{placed.name}' rests upright in the world of the photos"
    vertices = placed.vertices
    lowest = vertices[np.argmin(vertices @ up)]
    return Plane(up, lowest), f"level in the world of the photos, at the lowest point of '{placed.name}'"


def ground_below(placed: PlacedMesh, uprights: Float[np.ndarray, "k 3"] | None = None) -> Plane:
    """Return the plane, in the world, on which an object rests.

    Args:
        placed: the object
        uprights: unit up vectors of the cameras that see the object, in its own frame; by default that of this photo

    Raises:
        InputError: The object has no stable pose that is upright in its photos.
    """
    rotation = placed.rotation
    uprights = rotation.T[:, 1][None] if uprights is None else uprights
    plane = resting_plane(placed.mesh.vertices, placed.vertices, rotation, uprights)
    if plane is None:
        raise InputError(
            f"no stable pose of the object '{placed.name}' is upright in its photos, so its ground is unknown",
            key="beside",
            cure="name another object, or give the photo's `ground` in dataset.yaml",
        )
    return plane


def height_over(plane: Plane, placed: PlacedMesh) -> float:
    """Return the extent of an object along the plane's normal."""
    return float(np.ptp(placed.vertices @ plane.normal))


def floor_disc(scene: PhotoScene, plane: Plane) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the middle and the radius of the floor below the objects of a scene."""
    return plane.onto(scene.middle[None])[0], REACH * float(np.ptp(scene.points, axis=0).max()) / 2


def floor_rim(scene: PhotoScene, plane: Plane) -> Float[np.ndarray, "360 3"]:
    """Return points of the rim of the floor, in the world."""
    foot, radius = floor_disc(scene, plane)
    angle = np.radians(np.arange(360))
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(360)], axis=1)
    return foot + radius * circle @ rotation_between(np.array([0.0, 0.0, 1.0]), plane.normal).T


def smooth_step(t: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return 3t² − 2t³, which rises smoothly from 0 at t = 0 to 1 at t = 1, and is constant beyond."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def rotation_between(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation of one unit vector into another."""
    return Rotation.align_vectors(second[None], first[None])[0].as_matrix()


def disk(
    centre: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], radius: float, material: Reflectance
) -> dict[str, Any]:
    """Return a disk as Mitsuba's dictionary.

    Args:
        centre: its centre, in the world
        normal: unit normal of its upper side
        radius: its radius
        material: its reflectance
    """
    frame = rigid(radius * rotation_between(np.array([0.0, 0.0, 1.0]), normal), centre)
    return {"type": "disk", "to_world": transform(frame), "bsdf": bsdf(material)}


def on_floor(
    scene: PhotoScene,
    plane: Plane,
    reflectance: float,
    samples: int,
    world_from_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "h w 4"]:
    """Render the objects on a Lambertian floor, as `traced_photo` does without one.

    Args:
        scene: the scene
        plane: the plane of the floor
        reflectance: the floor's reflectance
        samples: samples per pixel
        world_from_camera: pose of the camera, in OpenCV's axes

    Returns:
        Linear radiance times coverage, and coverage.

    Raises:
        InputError: The camera is below the floor.
    """
    if (world_from_camera[:3, 3] - plane.point) @ plane.normal <= 0:
        raise InputError("the camera is below the floor", key="floor", cure="look from higher, or leave the floor out")
    foot, radius = floor_disc(scene, plane)
    grey = Reflectance((reflectance,) * 3, (0.0,) * 3, 1.0)
    floor = disk(foot - HAIR * radius * plane.normal, plane.normal, radius, grey)
    # L₀, L₁ and W
    without = traced_photo(scene, samples, world_from_camera)
    with_floor = traced_photo(scene, samples, world_from_camera, {"floor": floor})
    coverage = without[..., 3]
    # f, from the distance between the foot of the objects and the floor point of each pixel
    eye = world_from_camera[:3, 3]
    rays = (scene.camera.rays() @ world_from_camera[:3, :3].T).reshape(-1, 3)
    points = Plane(plane.normal, plane.point - eye).hit(rays) + eye
    distance = np.linalg.norm(points - foot, axis=-1).reshape(coverage.shape) / radius
    fade = smooth_step((1 - np.nan_to_num(distance, nan=np.inf)) / (1 - SOLID))
    weight = np.maximum(coverage, fade)[..., None]
    return weight * with_floor + (1 - weight) * without
