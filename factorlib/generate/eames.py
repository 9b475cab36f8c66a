"""Chair set: six photos of moulded side chairs in six lights, with all bounces of light, as cameras write them.

It is harder than the synthetic set in the ways of real photographs. Its JPEGs have clipped highlights. Its chairs
shadow and reflect themselves, each other and the ground. Its mesh is coarser than the rendered chair and a few
millimetres off. Poses, and half of the focal lengths, are unknown. With `exact` geometry it is easier, with `painted`
materials harder.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.schema import LEFT_OUT
from factorlib.generate import folder, surroundings
from factorlib.generate.chair import chair, label_parts, rough_chair
from factorlib.generate.paint import paint_mesh
from factorlib.generate.surroundings import EYE, Rng, SceneDict, random_materials
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh, smooth
from factorlib.meshes.ply_stl_off import submesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import (
    envmap,
    incident_light,
    look_rotation,
    painted_shape,
    render_scene,
    rigid,
    sensor,
)
from factorlib.yamlfile import read_yaml

Progress = Callable[[int, int, str], None]
Maps = Sequence[Path]
Materials = dict[str, Reflectance]
Meshes = dict[str, Mesh]
CHAIR: dict[str, Any] = {"file": "meshes/chair.obj", "parts": {"shell": "red", "legs": "wood"}}


class ChairSetOptions(msgspec.Struct, frozen=True):
    """Options of the chair set.

    width, height    size of photos, pixels
    light_rows       rows of light maps
    spp, light_spp   samples per pixel of photos and of light maps
    exact            the data set has the rendered mesh, poses and focal lengths
    painted          diffuse reflectance varies over wood and two of the shells (`factorlib.generate.paint`)
    """

    width: int = 480
    height: int = 360
    light_rows: int = 128
    spp: int = 224
    light_spp: int = 24
    exact: bool = False
    painted: bool = False


class ChairShot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Photo: shell colours of its chairs, pose of the first chair, lens, and surroundings.

    facing_deg         0 faces the camera, positive turns the front to the photo's right
    focal_35mm         focal length of the lens, 35 mm equivalent
    focal_known_from   source of the focal length in the data set: exif, given or nothing
    sun                elevation, and angle from behind the camera, degrees; None: a room
    """

    name: str
    chairs: tuple[str, ...]
    facing_deg: float
    distance: float
    eye: float
    focal_35mm: int
    focal_known_from: str
    sun: tuple[float, float] | None = None
    turbidity: float = 4.0
    windows: int = 2
    lamps: int = 2


class ChairSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of eames.yaml, which explains each number."""

    materials: dict[str, Reflectance]
    shots: list[ChairShot]
    clipped: float
    apart: float
    middle: float


SET = read_yaml(Path(__file__).with_name("eames.yaml"), ChairSet)


def generate(
    out: Path,
    seed: int,
    lat_longs: Maps,
    parameters: ChairSetOptions,
    progress: Progress,
    shots: Sequence[ChairShot] = SET.shots,
) -> None:
    """Write the data set into the empty folder `out`.

    Args:
        out: Empty folder.
        seed: Seed; 0 is the set in the repository.
        lat_longs: Light maps of the user, which replace the generated lights.
        parameters: Options of the set.
        progress: Called with the number of finished photos, their total, and the current photo's name.
        shots: Shots to render, one for each photo.
    """
    for name in ("photos", "masks", "meshes", "truth"):
        (out / name).mkdir(parents=True)
    rng = np.random.default_rng([11, seed])
    spread = 0.0 if seed == 0 else 1.0
    materials = random_materials(rng, 0.2 * spread, SET.materials)
    rough = rough_chair(rng)
    exact = {name: smooth(*part) for name, part in chair().items()} if parameters.exact else {}
    parts = {name: (mesh.vertices, mesh.faces, mesh.normals) for name, mesh in exact.items()} or rough
    folder.write_obj(out / CHAIR["file"], parts)
    labels = {name: label for label, name in enumerate(materials, start=1)}
    shells = {colour: labels[colour] for shot in shots for colour in shot.chairs}
    chairs = {name: label_parts(chair(), {"shell": label, "legs": labels["wood"]}) for name, label in shells.items()}
    if parameters.painted:
        chairs = {name: paint_mesh(mesh, seed, materials) for name, mesh in chairs.items()}
    photos = []
    poses = {}
    for number, shot in enumerate(shots):
        progress(number, len(shots), shot.name)
        scene = arrange_scene(shot, number, lat_longs, rng, spread, parameters)
        poses[shot.name] = scene.poses
        photos.append(write_chair_shot(out, scene, materials, chairs, parameters, 1000 * seed + number))
    options = "".join(f" --{name}" for name in ("exact", "painted") if getattr(parameters, name))
    comment = f"Generated (rendered, not photographed): python -m factorlib.generate eames{options}"
    folder.write_records(out, comment, materials, {"chair": CHAIR}, photos, poses)
    progress(len(shots), len(shots), "done")


class ChairScene(msgspec.Struct, frozen=True):
    """Photo before it is rendered: surroundings, camera and chairs in the world.

    The world has y up, the floor at −EYE, and the chairs about x = z = 0.
    """

    shot: ChairShot
    surroundings: SceneDict
    camera: Camera
    world_from_camera: Float[np.ndarray, "4 4"]
    chairs: dict[str, Float[np.ndarray, "4 4"]]  # world_from_object

    @property
    def poses(self) -> dict[str, Pose]:
        """Pose cam_from_object of each chair."""
        matrices = {name: np.linalg.inv(self.world_from_camera) @ chair for name, chair in self.chairs.items()}
        return {name: Pose(matrix[:3, :3], matrix[:3, 3]) for name, matrix in matrices.items()}


def arrange_scene(
    shot: ChairShot, number: int, lat_longs: Maps, rng: Rng, spread: float, parameters: ChairSetOptions
) -> ChairScene:
    """Place camera, chairs and surroundings of a shot; nothing is between camera and chairs.

    The surroundings are a sky, a room, or a user's map over a grey ground.

    Args:
        shot: The shot.
        number: Number of the shot.
        lat_longs: Light maps of the user.
        rng: Random generator.
        spread: Size of the random changes of chairs' rotations and camera position, from 0 to 1.
        parameters: Options of the set.

    Returns:
        The scene.
    """
    yaw = rng.uniform(0, 360)
    width = parameters.width
    height = parameters.height
    distance = shot.distance * (1 + 0.08 * spread * rng.uniform(-1, 1))
    eye = shot.eye + 0.15 * spread * rng.uniform(-1, 1)
    facing = shot.facing_deg + 40 * spread * rng.uniform(-1, 1)
    level = look_rotation(0, yaw)
    down = np.degrees(np.arctan2(eye - SET.middle, distance))
    place = -distance * level[:, 2] + [0, eye - EYE, 0]
    sideways = [0.0] if len(shot.chairs) == 1 else [-SET.apart, SET.apart]
    chairs = {}
    for k, (colour, aside) in enumerate(zip(shot.chairs, sideways)):
        # the chair's +z points toward the camera
        turn = look_rotation(0, yaw + 180 - facing + 55 * k) @ np.diag([-1.0, -1.0, 1.0])
        chairs[f"{colour}_chair"] = rigid(turn, aside * level[:, 0] + [0, -EYE, 0] + 0.15 * k * level[:, 2])
    camera = Camera(width, height, folder.focal_px_of_35mm(shot.focal_35mm, width, height), (width / 2, height / 2))
    if lat_longs:
        light = surroundings.read_captured_light(lat_longs[number % len(lat_longs)], parameters.light_rows)
        around = {"light": envmap(light), "ground": surroundings.wall("-y", EYE, (6.0, 6.0), (0.35, 0.33, 0.3))}
    elif shot.sun:
        up, aside = shot.sun
        around = surroundings.daylight(rng, up, yaw + 180 + aside, shot.turbidity, rows=2 * parameters.light_rows)
    else:
        around = surroundings.room(rng, shot.windows, shot.lamps, clear_deg=yaw + 180, clear_half_deg=120)
    return ChairScene(shot, around, camera, rigid(look_rotation(-down, yaw), place), chairs)


def write_chair_shot(
    out: Path, scene: ChairScene, materials: Materials, chairs: Meshes, parameters: ChairSetOptions, seed: int
) -> dict:
    """Render, expose and write one photo, with its masks, its light in the photo's units, and its true maps.

    Args:
        out: Folder of the data set.
        scene: The scene.
        materials: Materials by name, in the order of their labels.
        chairs: Chair with a shell of each colour.
        parameters: Parameters of the set.
        seed: Seed of the renderer.

    Returns:
        The photo's entry of dataset.yaml. It has poses only if `exact`, and the focal length only if `exact` or if the
        shot gives it there.
    """
    shot = scene.shot
    camera = scene.camera
    poses = list(scene.poses.values())
    meshes = [chairs[colour] for colour in shot.chairs]
    labels = folder.label_pixels(meshes, camera, poses)
    light, radiance = render_shot(scene, meshes, list(materials.values()), parameters, seed)
    # exposure that clips the share `clipped` of the chairs' pixels
    on_chair = (labels > 0) & (labels < LEFT_OUT)
    exposure = float(1 / np.quantile(radiance[on_chair].max(axis=-1), 1 - SET.clipped))
    exif = shot.focal_35mm if shot.focal_known_from == "exif" else None
    folder.write_photo(out / f"photos/{shot.name}.jpg", radiance * exposure, exif)
    folder.write_mask_and_truth(out, shot.name, labels, light * exposure, rasterise(meshes, camera, poses))
    if parameters.painted:
        albedo = folder.albedo_map(meshes, list(materials.values()), camera, poses)
        folder.write_rgb_exr(out / f"truth/{shot.name}_albedo.exr", albedo)
    shells = zip(scene.chairs, shot.chairs, strict=True)
    objects: list[Any] = [{"name": name, "mesh": "chair", "materials": {"shell": colour}} for name, colour in shells]
    if len(meshes) > 1:  # a mask for each chair
        for obj, mask in zip(objects, folder.object_masks(meshes, camera, poses), strict=True):
            obj["mask"] = f"masks/{shot.name}_{obj['name']}.png"
            folder.write_labels(out / obj["mask"], np.where(mask, 255, 0))
    if parameters.exact:
        objects = [obj | {"pose": folder.pose_entry(pose)} for obj, pose in zip(objects, poses, strict=True)]
    entry: dict[str, Any] = {"name": shot.name, "image": f"photos/{shot.name}.jpg", "masks": f"masks/{shot.name}.png"}
    if parameters.exact or shot.focal_known_from == "given":
        entry["camera"] = {"focal_px": round(camera.focal, 2)}
    return entry | {"objects": objects}


def render_shot(
    scene: ChairScene, meshes: Sequence[Mesh], materials: Sequence[Reflectance], parameters: ChairSetOptions, seed: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """Render the light at the chairs' centre, without the chairs, and the photo.

    Args:
        scene: The scene.
        meshes: Mesh of each chair.
        materials: Materials in the order of their labels.
        parameters: Parameters of the set.
        seed: Seed of the renderer.

    Returns:
        The light's map in the camera's y-up frame, and the photo's radiance.
    """
    around = scene.surroundings
    world_from_light = scene.world_from_camera[:3, :3] @ YUP_FROM_CAMERA
    place = rigid(world_from_light, (0, SET.middle - EYE, 0))
    light = incident_light(around, place, parameters.light_rows, parameters.light_spp, seed)
    solids = {
        f"{name}_{label}": painted_shape(submesh(mesh, label), materials[label - 1], world_from_object)
        for mesh, (name, world_from_object) in zip(meshes, scene.chairs.items(), strict=True)
        for label in mesh.labels
    }
    film = sensor(scene.camera, scene.world_from_camera)
    return light, render_scene(around | solids, film, parameters.spp, seed, max_depth=-1)
