"""Objects on a grey floor that receives their shadow and fades out around them.

W is the share of a pixel that objects fill.  f falls from 1 beneath the objects to 0 at `REACH` of their size.  The
picture is

    w L₁ + (1 − w) L₀,    w = max(W, f),

where L₁ and L₀ are path-traced with the floor and without it.
"""

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.export.exported_scene import DIRECT
from factorlib.render.ground import Plane
from factorlib.render.photo_scene import PhotoScene, traced_photo
from factorlib.render.placement import disk
from factorlib.results.materials import Reflectance

REACH = 3.0  # radius of the floor, in half extents of the objects
SOLID = 0.3  # share of the radius within which the floor does not fade
HAIR = 1e-4  # depth of the floor below the plane, in half extents: surfaces must not touch
COVERAGE_SAMPLES = 16


def on_floor(
    scene: PhotoScene,
    plane: Plane,
    reflectance: float,
    samples: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    with_light: bool = False,
) -> Float[np.ndarray, "h w 4"]:
    """Render the objects on a Lambertian floor, as `traced_photo` does without one.

    Args:
        scene: the scene
        plane: the plane of the floor
        reflectance: the floor's reflectance
        samples: samples per pixel
        world_from_camera: pose of the camera, in OpenCV's axes
        with_light: show the light behind the objects

    Returns:
        Linear radiance times coverage, and coverage.

    Raises:
        InputError: The camera is below the floor.
    """
    if (world_from_camera[:3, 3] - plane.point) @ plane.normal <= 0:
        raise InputError("the camera is below the floor", key="floor", cure="look from higher, or leave the floor out")
    points = np.concatenate([each.vertices for each in scene.objects])
    extent = float(np.ptp(points, axis=0).max()) / 2
    foot = plane.onto(scene.middle[None])[0]
    grey = Reflectance((reflectance,) * 3, (0.0,) * 3, 1.0)
    floor = disk(foot - HAIR * extent * plane.normal, plane.normal, REACH * extent, grey)
    # L₀, L₁ and W
    without = traced_photo(scene, samples, world_from_camera, with_light)
    with_ = traced_photo(scene, samples, world_from_camera, with_light, {"floor": floor})
    alone = traced_photo(scene, COVERAGE_SAMPLES, world_from_camera, max_depth=DIRECT)[..., 3]
    # f, from the distance between the foot of the objects and the floor point of each pixel
    eye = world_from_camera[:3, 3]
    rays = (scene.camera.rays() @ world_from_camera[:3, :3].T).reshape(-1, 3)
    points = Plane(plane.normal, plane.point - eye).hit(rays) + eye
    distance = np.linalg.norm(points - foot, axis=-1).reshape(alone.shape) / (REACH * extent)
    t = np.clip((1 - np.nan_to_num(distance, nan=np.inf)) / (1 - SOLID), 0, 1)
    weight = np.maximum(alone, t * t * (3 - 2 * t))[..., None]
    return weight * with_ + (1 - weight) * without
