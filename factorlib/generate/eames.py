"""The chair set: six photos of moulded side chairs in six lights, with all bounces of light, as cameras write them.

What makes it harder than the synthetic set is what makes photographs hard: JPEGs with clipped highlights, chairs that
shadow and mirror themselves, each other and the ground, a mesh coarser than and a few millimetres off the chair that
was photographed, no poses, and half of the focal lengths unknown.  Three of these can be taken away, each by itself, so that
one sees what each costs: `exact` geometry, `distant` light, `direct` light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.generate import folder, lights
from factorlib.generate.chair import Part, chair, labelled, rough_chair
from factorlib.generate.drawn import drawn_materials
from factorlib.generate.lights import EYE, SceneDict
from factorlib.generate.shapes import smooth
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import submesh
from factorlib.tracing.scene import Material, bsdf, envmap, light_seen, look, rigid, shape, traced, transform
from factorlib.yamlfile import read_yaml

Progress = Callable[[int, int, str], None]


class Parameters(msgspec.Struct, frozen=True):
    """Pixels, pixels, rows, samples per pixel of photos and of lights, and what is made easier.

    exact:    the data set's mesh is the one that was photographed, and poses and focal lengths are given
    distant:  nothing lights or surrounds the chairs but the light's map, infinitely far away
    direct:   light is not reflected on its way: only what shines by itself lights the chairs
    """

    width: int = 480
    height: int = 360
    light_rows: int = 128
    spp: int = 224
    light_spp: int = 24
    exact: bool = False
    distant: bool = False
    direct: bool = False

    @property
    def options(self) -> str:
        """What is made easier, as options of the command."""
        return "".join(f" --{name}" for name in ("exact", "distant", "direct") if getattr(self, name))


class Shot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A photo: shell colours of its chairs, how the first stands to the camera, the lens, and the surroundings.

    facing_deg    0 looks at the camera, positive turns its front to the photo's right
    focal_35mm    the lens; how the data set tells it: exif, given or nothing
    sun           elevation and how far from behind the camera, degrees; None: a room
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


class Set(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What eames.yaml says, where each number is explained."""

    materials: dict[str, Material]
    shots: list[Shot]
    clipped: float
    apart: float
    middle: float


SET = read_yaml(Path(__file__).with_name("eames.yaml"), Set)


def generate(
    out: Path,
    seed: int,
    lat_longs: Sequence[Path],
    parameters: Parameters,
    progress: Progress,
    shots: Sequence[Shot] = SET.shots,
) -> None:
    """Write the data set into the empty folder `out`; `lat_longs` (maps of the user's) replace the made lights."""
    for name in ("photos", "masks", "meshes", "truth"):
        (out / name).mkdir(parents=True)
    rng = np.random.default_rng([11, seed])
    materials = drawn_materials(rng, 0.0 if seed == 0 else 0.2, SET.materials)
    write_mesh(out / "meshes/chair.obj", rough_chair(rng), parameters)
    photos, poses = [], {}
    for number, shot in enumerate(shots):
        progress(number, len(shots), shot.name)
        scene = laid_out(shot, number, lat_longs, rng, 0.0 if seed == 0 else 1.0, parameters)
        poses[shot.name] = scene.poses()
        photos.append(write_shot(out, scene, materials, parameters, 1000 * seed + number))
    write_records(out, materials, photos, poses, parameters)
    progress(len(shots), len(shots), "done")


def write_mesh(path: Path, rough: dict[str, Part], parameters: Parameters) -> None:
    """The mesh given: the rough one, or the one that is photographed."""
    if parameters.exact:
        folder.write_exact_obj(path, {name: smooth(*part) for name, part in chair().items()})
    else:
        folder.write_obj(path, rough)


class Scene(msgspec.Struct, frozen=True):
    """A photo before it is taken: surroundings, camera and chairs in the world (y up, floor at −EYE, chairs about x = z = 0)."""

    shot: Shot
    surroundings: SceneDict
    camera: Camera
    world_from_camera: Float[np.ndarray, "4 4"]
    chairs: dict[str, Float[np.ndarray, "4 4"]]  # world_from_object

    def poses(self) -> dict[str, Pose]:
        """cam_from_object of each chair."""
        matrices = {name: np.linalg.inv(self.world_from_camera) @ chair for name, chair in self.chairs.items()}
        return {name: Pose(matrix[:3, :3], matrix[:3, 3]) for name, matrix in matrices.items()}


def laid_out(
    shot: Shot, number: int, lat_longs: Sequence[Path], rng: np.random.Generator, spread: float, parameters: Parameters
) -> Scene:
    """Camera, chairs and surroundings of a shot; a spread turns the chairs and moves the camera."""
    yaw = rng.uniform(0, 360)
    distance, eye = (
        shot.distance * (1 + 0.08 * spread * rng.uniform(-1, 1)),
        shot.eye + 0.15 * spread * rng.uniform(-1, 1),
    )
    facing = shot.facing_deg + 40 * spread * rng.uniform(-1, 1)
    level = look(0, yaw)
    down = np.degrees(np.arctan2(eye - SET.middle, distance))
    place = -distance * level[:, 2] + [0, eye - EYE, 0]
    sideways = [0.0] if len(shot.chairs) == 1 else [-SET.apart, SET.apart]
    chairs = {}
    for k, (colour, aside) in enumerate(zip(shot.chairs, sideways)):
        turn = look(0, yaw + 180 - facing + 55 * k) @ np.diag([-1.0, -1.0, 1.0])  # the chair's +z toward the camera
        chairs[f"{colour}_chair"] = rigid(turn, aside * level[:, 0] + [0, -EYE, 0] + 0.15 * k * level[:, 2])
    focal = folder.focal_px_of_35mm(shot.focal_35mm, parameters.width, parameters.height)
    camera = Camera(parameters.width, parameters.height, focal, (parameters.width / 2, parameters.height / 2))
    around = surroundings(shot, yaw, number, lat_longs, rng, parameters)
    return Scene(shot, around, camera, rigid(look(-down, yaw), place), chairs)


def surroundings(
    shot: Shot, yaw_deg: float, number: int, lat_longs: Sequence[Path], rng: np.random.Generator, parameters: Parameters
) -> SceneDict:
    """A sky, a room, or a user's map over a grey ground (without it where light is `distant`); nothing stands between camera and chairs."""
    if lat_longs:
        light = lights.captured(lat_longs[number % len(lat_longs)], parameters.light_rows)
        ground = {} if parameters.distant else {"ground": lights.wall("-y", EYE, (6.0, 6.0), (0.35, 0.33, 0.3))}
        return {"light": envmap(light), **ground}
    if shot.sun:
        return lights.daylight(
            rng, shot.sun[0], yaw_deg + 180 + shot.sun[1], shot.turbidity, rows=2 * parameters.light_rows
        )
    return lights.room(rng, shot.windows, shot.lamps, clear_deg=yaw_deg + 180, clear_half_deg=120)


def write_shot(
    out: Path, scene: Scene, materials: dict[str, Material], parameters: Parameters, seed: int
) -> dict[str, Any]:
    """Trace, expose and write one photo, its masks, its light in the photo's units and its normals; its entry."""
    shot, order, poses = scene.shot, list(materials), list(scene.poses().values())
    meshes = [
        labelled(chair(), {"shell": order.index(colour) + 1, "legs": order.index("wood") + 1}) for colour in shot.chairs
    ]
    labels = folder.labels_of(meshes, scene.camera, poses)
    light = light_at_chairs(scene, parameters, seed)
    around = distant(light, scene) if parameters.distant else scene.surroundings
    depth = 2 if parameters.direct else -1
    radiance = traced(
        around | solids(scene, meshes, materials), scene.camera, scene.world_from_camera, parameters.spp, seed, depth
    )
    exposure = exposure_of(radiance, (labels > 0) & (labels < folder.LEFT_OUT))
    folder.write_photo(
        out / f"photos/{shot.name}.jpg",
        radiance * exposure,
        shot.focal_35mm if shot.focal_known_from == "exif" else None,
    )
    folder.write_labels(out / f"masks/{shot.name}.png", labels)
    for name, mask in own_masks(scene, meshes, poses).items():
        folder.write_labels(out / name, np.where(mask, 255, 0))
    folder.write_light(out / f"truth/{shot.name}_light.exr", light * exposure)
    folder.write_normals(out / f"truth/{shot.name}_normal.exr", rasterise(meshes, scene.camera, poses).normal)
    return entry(scene, parameters.exact)


def world_from_light(scene: Scene) -> Float[np.ndarray, "3 3"]:
    """The light's frame is the camera's, turned y-up."""
    return scene.world_from_camera[:3, :3] @ YUP_FROM_CAMERA


def distant(light: Float[np.ndarray, "h w 3"], scene: Scene) -> SceneDict:
    """The map alone, infinitely far away."""
    return {"light": envmap(light) | {"to_world": transform(rigid(world_from_light(scene), (0, 0, 0)))}}


def light_at_chairs(scene: Scene, parameters: Parameters, seed: int) -> Float[np.ndarray, "h w 3"]:
    """The surroundings' light at the chairs' middle, without the chairs; where light is direct but not distant, what shines by itself."""
    depth = 1 if parameters.direct and not parameters.distant else -1
    place = (0, SET.middle - EYE, 0)
    return light_seen(
        scene.surroundings,
        rigid(world_from_light(scene), place),
        parameters.light_rows,
        parameters.light_spp,
        seed,
        depth,
    )


def solids(scene: Scene, meshes: Sequence[Mesh], materials: dict[str, Material]) -> dict[str, Any]:
    """The chairs as Mitsuba shapes, one for each material of each."""
    names = list(materials)
    return {
        f"{name}_{label}": shape(submesh(mesh, label), bsdf(materials[names[label - 1]]), world_from_object)
        for mesh, (name, world_from_object) in zip(meshes, scene.chairs.items(), strict=True)
        for label in mesh.labels
    }


def exposure_of(radiance: Float[np.ndarray, "h w 3"], on_chair: Bool[np.ndarray, "h w"]) -> float:
    """The factor that clips `clipped` of the chairs' pixels."""
    return float(1 / np.quantile(radiance[on_chair].max(axis=-1), 1 - SET.clipped))


def own_masks(scene: Scene, meshes: Sequence[Mesh], poses: Sequence[Pose]) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Path -> silhouette of each chair where there are two."""
    if len(meshes) == 1:
        return {}
    masks = folder.object_masks(meshes, scene.camera, poses)
    return {own_mask(scene.shot, name): mask for name, mask in zip(scene.chairs, masks, strict=True)}


def own_mask(shot: Shot, name: str) -> str:
    """Path of the silhouette of chair `name`, relative to the data set."""
    return f"masks/{shot.name}_{name}.png"


def entry(scene: Scene, exact: bool) -> dict[str, Any]:
    """The photo in dataset.yaml; poses only if `exact`, the focal length only then and where the user is to give it there."""
    shot, objects = scene.shot, []
    for colour, (name, pose) in zip(shot.chairs, scene.poses().items(), strict=True):
        mask = {"mask": own_mask(shot, name)} if len(shot.chairs) > 1 else {}
        posed = {"pose": folder.pose_entry(pose)} if exact else {}
        objects.append({"name": name, "mesh": "chair", "materials": {"shell": colour}, **mask, **posed})
    camera = {"camera": {"focal_px": round(scene.camera.focal, 2)}} if exact or shot.focal_known_from == "given" else {}
    return {
        "name": shot.name,
        "image": f"photos/{shot.name}.jpg",
        "masks": f"masks/{shot.name}.png",
        **camera,
        "objects": objects,
    }


def write_records(
    out: Path,
    materials: dict[str, Material],
    photos: list[dict],
    poses: dict[str, dict[str, Pose]],
    parameters: Parameters,
) -> None:
    """dataset.yaml and truth/truth.yaml."""
    meshes = {"chair": {"file": "meshes/chair.obj", "parts": {"shell": "red", "legs": "wood"}}}
    record = {
        "format": 1,
        "materials": list(materials),
        "meshes": meshes,
        "photos": photos,
        "truth": "truth/truth.yaml",
    }
    command = f"python -m factorlib.generate eames{parameters.options}"
    folder.write_yaml(out / "dataset.yaml", record, f"Generated (rendered, not photographed): {command}")
    folder.write_truth(out, materials, poses)
