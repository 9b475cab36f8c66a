"""Outlines and photos of made bodies, seen from known cameras."""

import numpy as np
from scipy.ndimage import map_coordinates

from factorlib.align.silhouette import with_prior_focal
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.shapes.motion import PhotoForMotion
from factorlib.shapes.outline import Outline

CAMERA = Camera(320, 240, 400.0, (160.0, 120.0))
GRAINS = np.random.default_rng(0).random((64, 64, 64))


def looking_from(elevation_deg, azimuth_deg, distance=5.0, roll=0.2) -> Pose:
    """cam_from_object of a camera that looks past the origin from there, y up."""
    up, about = np.deg2rad([elevation_deg, azimuth_deg])
    eye = distance * np.array([np.cos(up) * np.sin(about), np.sin(up), np.cos(up) * np.cos(about)])
    ahead = -eye / distance
    right = np.cross(ahead, [0, 1, 0]) / np.linalg.norm(np.cross(ahead, [0, 1, 0]))
    rotation = rotation_of_vector(np.array([0, 0, roll])) @ np.stack([right, np.cross(ahead, right), ahead])
    return Pose(rotation, -rotation @ eye + np.array([0.2, 0.1, 0.0]))


def outline(mesh, pose, known, camera=CAMERA, name="p") -> Outline:
    """What a photo shows of a mesh, its labels as parts; known: whether the pose is."""
    return Outline(name, rasterise(mesh, camera, pose).label.astype(int), camera, pose=pose if known else None)


def plane(y) -> Mesh:
    """A large square."""
    corners = np.array([[-6, y, -6], [6, y, -6], [6, y, 6], [-6, y, 6]], float)
    normals = np.tile([0.0, 1.0, 0.0], (4, 1))
    return Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32), normals, np.array([2, 2], np.int16))


def grained(points) -> np.ndarray:
    """A texture in space, 0 to 1."""
    return sum(
        map_coordinates(GRAINS, (points * s % 64).T, order=1, mode="wrap") * w
        for s, w in ((8, 0.5), (16, 0.3), (32, 0.2))
    )


def views_of(mesh, poses, ground, size=320) -> dict[str, PhotoForMotion]:
    """Photos of a grained body on a grained ground.  ground: cam_from_ground of each; what is not seen is black."""
    camera, views = Camera(size, size, 1.3 * size, (size / 2, size / 2)), {}
    for number, (pose, of_ground) in enumerate(zip(poses, ground, strict=True)):
        maps = rasterise([mesh, plane(-0.6)], camera, [pose, of_ground])
        places, grey = camera.rays() * maps.depth[..., None], np.zeros((size, size))
        for label, own, scale in ((1, pose, 2.0), (2, of_ground, 1.0)):
            visible = maps.label == label
            grey[visible] = grained(scale * (places[visible] - own.translation) @ own.rotation)
        pixels = (np.clip(grey, 0, 1) * 255).astype(np.uint8)
        prior = with_prior_focal(camera, None, None)
        views[f"p{number}"] = PhotoForMotion(pixels, maps.label == 1, np.zeros((size, size), bool), *prior)
    return views
