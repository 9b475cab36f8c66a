"""Synthetic set: three materials in three lights on exact shapes at given poses, with all ground truth known.

Each object is traced alone in its light by direct light only, so that the image satisfies the model exactly: no object
shadows or reflects another. One photo is a linear EXR, one a 16-bit PNG, one an 8-bit JPEG with some highlights
clipped; one pose is not given. Seed 0 is the set in the repository; others have other materials, views and lights.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.schema import LEFT_OUT
from factorlib.generate import folder
from factorlib.generate.solids import SHAPES
from factorlib.generate.surroundings import Rng, Rotation, daylight, random_materials, read_captured_light, room
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import bsdf, envmap, incident_light, look_rotation, render_scene, rigid, sensor, shape

Progress = Callable[[int, int, str], None]
DISTANCE = 5.0
MATERIALS = {
    "red": Reflectance((0.5, 0.12, 0.1), (0.08, 0.08, 0.08), 0.6),
    "green": Reflectance((0.1, 0.35, 0.14), (0.25, 0.25, 0.25), 0.35),
    "blue": Reflectance((0.12, 0.16, 0.24), (0.4, 0.4, 0.4), 0.22),
}


class SyntheticOptions(msgspec.Struct, frozen=True):
    """Options of the synthetic set.

    width, height    size of photos, pixels
    focal_px         focal length, pixels
    light_rows       rows of light maps
    spp, light_spp   samples per pixel of photos and of light maps
    """

    width: int = 192
    height: int = 128
    focal_px: float = 250.0
    light_rows: int = 128
    spp: int = 2048
    light_spp: int = 48


class Placement(msgspec.Struct, frozen=True):
    """Shape of a material in a photo.

    x      position across, at the distance DISTANCE
    turn   rotation about the vertical, radians
    tilt   rotation about two axes after that, radians
    posed  True if the data set gives the pose
    """

    shape: str
    material: str
    x: float
    turn: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    posed: bool = True

    @property
    def name(self) -> str:
        """Name of the object: its material and its shape."""
        return f"{self.material}_{self.shape}"


class SyntheticShot(msgspec.Struct, frozen=True):
    """Photo: suffix of its file, its objects, and the fraction of object pixels that is clipped (None: nothing)."""

    name: str
    suffix: str
    placements: tuple[Placement, ...]
    clipped: float | None = None


SHOTS = (
    SyntheticShot(
        "garden",
        ".exr",
        (Placement("sphere", "red", -1.22), Placement("vase", "green", 0.0), Placement("blob", "blue", 1.22, 0.6)),
    ),
    SyntheticShot(
        "parlour",
        ".png",
        (Placement("bottle", "green", -1.22), Placement("sphere", "blue", 0.0), Placement("vase", "red", 1.22)),
    ),
    SyntheticShot(
        "study",
        ".jpg",
        (
            Placement("blob", "red", -1.22, 2.2, (0.2, -0.3), posed=False),
            Placement("bottle", "blue", 0.0, 0.0, (0.25, 0.15)),
            Placement("sphere", "green", 1.22),
        ),
        clipped=0.03,
    ),
)


class SyntheticScene(msgspec.Struct, frozen=True):
    """Contents of one photo: objects in one light.

    light       lat-long map in the camera's y-up frame, radiance in its own unit
    materials   materials by name, in the order of their labels
    meshes      meshes by shape
    poses       cam_from_object by the object's name, in the order of `shot.placements`
    """

    shot: SyntheticShot
    light: Float[np.ndarray, "h w 3"]
    materials: dict[str, Reflectance]
    meshes: dict[str, Mesh]
    poses: dict[str, Pose]


def generate(out: Path, seed: int, lat_longs: Sequence[Path], parameters: SyntheticOptions, progress: Progress) -> None:
    """Write the data set into the empty folder `out`.

    Args:
        out: Empty folder.
        seed: Seed; 0 is the set in the repository.
        lat_longs: Light maps of the user, which replace the generated lights.
        parameters: Options of the set.
        progress: Called with the number of finished steps, their total, and the current step.
    """
    for name in ("photos", "masks", "meshes", "truth"):
        (out / name).mkdir(parents=True)
    rng = np.random.default_rng([7, seed])
    spread = 0.0 if seed == 0 else 1.0
    materials = random_materials(rng, 0.25 * spread, MATERIALS)
    meshes = {name: make() for name, make in SHAPES.items()}
    for name, mesh in meshes.items():
        write_ply(out / f"meshes/{name}.ply", mesh)
    photos = []
    poses = {}
    for number, shot in enumerate(SHOTS):
        progress(2 * number, 2 * len(SHOTS), f"light of {shot.name}")
        world_from_camera = look_rotation(rng.uniform(-14, -6), rng.uniform(0, 360))
        light = photo_light(number, world_from_camera, lat_longs, rng, parameters.light_rows, parameters.light_spp)
        progress(2 * number + 1, 2 * len(SHOTS), f"photo {shot.name}")
        poses[shot.name] = place_objects(shot, world_from_camera, rng, spread)
        photos.append(
            write_shot(out, SyntheticScene(shot, light, materials, meshes, poses[shot.name]), parameters, seed)
        )
    used = {placement.name: placement for shot in SHOTS for placement in shot.placements}
    entries = {name: {"file": f"meshes/{p.shape}.ply", "material": p.material} for name, p in used.items()}
    comment = "Generated: python -m factorlib.generate synthetic"
    folder.write_records(out, comment, materials, entries, photos, poses)
    progress(2 * len(SHOTS), 2 * len(SHOTS), "done")


def photo_light(
    number: int, world_from_camera: Rotation, lat_longs: Sequence[Path], rng: Rng, rows: int, spp: int
) -> Float[np.ndarray, "h w 3"]:
    """Return the light of a photo in the camera's y-up frame.

    It is one of `lat_longs`. Without them, photo 0 has daylight, with the sun behind the camera to its left or right,
    and the others have rooms with as many lamps as their number.

    Args:
        number: Number of the photo.
        world_from_camera: Rotation of the camera.
        lat_longs: Light maps of the user.
        rng: Random generator.
        rows: Rows of the map.
        spp: Samples per pixel.

    Returns:
        A lat-long map.
    """
    if lat_longs:
        return read_captured_light(lat_longs[number % len(lat_longs)], rows)
    seed = int(rng.integers(1 << 24))
    if number:
        scene = room(rng, windows=2, lamps=number)
    else:
        forward = np.degrees(np.arctan2(world_from_camera[0, 2], world_from_camera[2, 2]))
        up = rng.uniform(30, 50)
        turn = rng.choice([-1, 1]) * rng.uniform(35, 70)
        scene = daylight(rng, up, forward + 180 + turn, rows=2 * rows)
    return incident_light(scene, rigid(world_from_camera @ YUP_FROM_CAMERA, (0, 0, 0)), rows, spp, seed)


def place_objects(
    shot: SyntheticShot, world_from_camera: Rotation, rng: np.random.Generator, spread: float
) -> dict[str, Pose]:
    """Return cam_from_object of each object, upright in the world but for its tilt.

    Args:
        shot: The shot.
        world_from_camera: Rotation of the camera.
        rng: Random generator.
        spread: Size of the random rotations, from 0 to 1.

    Returns:
        Poses by the object's name.
    """
    poses = {}
    for placement in shot.placements:
        turn = rotation_of_vector(np.array([0, placement.turn + spread * rng.uniform(-np.pi, np.pi), 0]))
        tilt = np.array([placement.tilt[0], 0, placement.tilt[1]])
        tilt = rotation_of_vector(tilt + spread * np.array([1, 0, 1]) * rng.uniform(-0.2, 0.2, 3))
        poses[placement.name] = Pose(world_from_camera.T @ tilt @ turn, np.array([placement.x, 0.02, DISTANCE]))
    return poses


def write_shot(out: Path, scene: SyntheticScene, parameters: SyntheticOptions, seed: int) -> dict:
    """Render, expose and write one photo, with its mask, its light in the photo's units, and its normals.

    Args:
        out: Folder of the data set.
        scene: The scene.
        parameters: Options of the set.
        seed: Seed of the renderer.

    Returns:
        The photo's entry of dataset.yaml.
    """
    shot = scene.shot
    poses = list(scene.poses.values())
    order = list(scene.materials)
    width = parameters.width
    height = parameters.height
    camera = Camera(width, height, parameters.focal_px, (width / 2, height / 2))
    labelled = []
    for placement in shot.placements:
        mesh = scene.meshes[placement.shape]
        label = np.full(len(mesh.faces), order.index(placement.material) + 1, np.int16)
        labelled.append(msgspec.structs.replace(mesh, face_label=label))
    labels = folder.label_pixels(labelled, camera, poses)
    radiance = compose_photo(scene, camera, parameters.spp, seed)
    # exposure that clips the given fraction of object pixels, or just none; a float file gets a mean of ¼
    brightest = radiance[(labels > 0) & (labels < LEFT_OUT)].max(axis=-1)
    exposure = float(1 / np.quantile(brightest, 1 - shot.clipped) if shot.clipped else 0.95 / brightest.max())
    if shot.suffix == ".exr":
        exposure = float(0.25 / brightest.mean())
    folder.write_photo(out / f"photos/{shot.name}{shot.suffix}", radiance * exposure, quality=98)
    folder.write_mask_and_truth(out, shot.name, labels, scene.light * exposure, rasterise(labelled, camera, poses))
    objects: list[dict[str, Any]] = [{"name": p.name, "mesh": p.name} for p in shot.placements]
    for entry, placement in zip(objects, shot.placements, strict=True):
        if placement.posed:
            entry["pose"] = folder.pose_entry(scene.poses[placement.name])
    return {
        "name": shot.name,
        "image": f"photos/{shot.name}{shot.suffix}",
        "masks": f"masks/{shot.name}.png",
        "camera": {"focal_px": parameters.focal_px},
        "objects": objects,
    }


def compose_photo(scene: SyntheticScene, camera: Camera, spp: int, seed: int) -> Float[np.ndarray, "h w 3"]:
    """Compose the photo: each pixel is taken from the render of the nearest object alone.

    The background is the same in all renders.

    Args:
        scene: The scene.
        camera: Camera.
        spp: Samples per pixel.
        seed: Seed of the renderer.

    Returns:
        Radiance.
    """
    shot = scene.shot
    meshes = scene.meshes
    poses = list(scene.poses.values())
    radiance = np.zeros((camera.height, camera.width, 3))
    world = rigid(YUP_FROM_CAMERA, np.zeros(3))
    silhouettes = folder.object_masks([meshes[placement.shape] for placement in shot.placements], camera, poses)
    nearest = np.argmin([distance_transform_edt(~inside) for inside in silhouettes], axis=0)
    for number, (placement, pose) in enumerate(zip(shot.placements, poses, strict=True)):
        place = world @ rigid(pose.rotation, pose.translation)
        solid = shape(meshes[placement.shape], bsdf(scene.materials[placement.material]), place)
        mask = nearest == number
        used = np.flatnonzero(mask.any(axis=0))
        columns = slice(used[0], used[-1] + 1)
        entries = {"shape": solid, "light": envmap(scene.light)}
        rendering = render_scene(entries, sensor(camera, world, columns), spp, 100 * seed + number, max_depth=2)
        radiance[:, columns][mask[:, columns]] = rendering[mask[:, columns]]
    return radiance
