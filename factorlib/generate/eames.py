"""The Internet-Eames protocol of Wang, Ritschel and Mitra 2018: six photos of one chair in four plastics, on wooden legs.

The paper's photographs cannot be had; these are rendered.  Each photo shows one or two chairs on a tiled ground under
its own far surroundings, by all bounces of light, as an sRGB JPEG of a fixed quality whose highlights clip.  What makes
the set hard is left in: chairs mirror and shade themselves, each other and the ground, no pose is given, half the
focal lengths are unknown, and the mesh that goes with the photos (`chair.GIVEN`) is not the one rendered (`chair.RENDERED`).

World      y up, ground at 0, metres.  A view is aimed from `azimuth` (0: in front of a chair that is not turned).
Truth      illumination is the light that arrives at the middle of the seats with the chairs away and the ground there,
           in the photo's units; normals and poses are those of the rendered mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.align.camera import Camera, Pose, rotation_of_vector
from factorlib.align.raster import rasterise
from factorlib.conventions import LUMINANCE, YUP_FROM_CAMERA
from factorlib.generate import folder, lights
from factorlib.generate.chair import GIVEN, LEGS, RENDERED, SHELL, chair, parts
from factorlib.generate.lights import Things
from factorlib.generate.synthetic import drawn_materials
from factorlib.generate.tracing import Material, bsdf, envmap, light_seen, look, rgb, rigid, shape, traced, transform
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import submesh

Progress = Callable[[int, int, str], None]
SEAT = np.array([0.0, 0.45, 0.0])  # where the light is measured, and where the cameras aim
FILLS = 0.82  # of the frame, by the chairs
GREY, MOST_CLIPPED = 0.2, 0.02  # mean luminance of a photo; of the chairs' pixels, at most


class Parameters(msgspec.Struct, frozen=True):
    """size: long side of a photo, pixels.  far_rows: of the map that surrounds the scene.  *_spp: samples per pixel."""

    size: int = 640
    far_rows: int = 256
    light_rows: int = 128
    spp: int = 256
    light_spp: int = 32


class Seat(msgspec.Struct, frozen=True):
    """A chair of a colour, so far (metres) to the right of the photo's middle and nearer the camera, turned about y."""

    colour: str
    right: float = 0.0
    nearer: float = 0.0
    turn_deg: float = 0.0


class View(msgspec.Struct, frozen=True):
    """A photo: its chairs, where from, the lens (mm on 35 mm film; told by EXIF or not), and its surroundings."""

    name: str
    seats: tuple[Seat, ...]
    azimuth_deg: float
    height: float
    film_mm: float
    surroundings: str
    exif: bool = True
    portrait: bool = False
    tiles: tuple[float, float, float] = (0.35, 0.33, 0.3)


MATERIALS = {
    "red": Material((0.52, 0.05, 0.035), (0.065, 0.065, 0.065), 0.32),
    "yellow": Material((0.66, 0.39, 0.045), (0.06, 0.06, 0.06), 0.36),
    "black": Material((0.025, 0.025, 0.028), (0.075, 0.075, 0.075), 0.30),
    "white": Material((0.68, 0.665, 0.61), (0.055, 0.055, 0.055), 0.38),
    "wood": Material((0.44, 0.27, 0.135), (0.04, 0.038, 0.034), 0.5),
}
VIEWS = (
    View("patio", (Seat("red"),), 32.0, 1.25, 35.3, "noon", tiles=(0.42, 0.38, 0.33)),
    View("gallery", (Seat("white", -0.34, 0.1, 25.0), Seat("yellow", 0.36, -0.1, -30.0)), 8.0, 1.35, 41.7, "room", exif=False, tiles=(0.4, 0.28, 0.17)),
    View("terrace", (Seat("black"),), -48.0, 0.95, 50.4, "evening", portrait=True),
    View("loft", (Seat("white"),), 141.0, 1.2, 29.6, "windows", tiles=(0.3, 0.3, 0.31)),
    View("court", (Seat("red", 0.36, 0.0, -120.0), Seat("black", -0.36, 0.0, 15.0)), 22.0, 1.5, 62.0, "overcast", exif=False, tiles=(0.5, 0.49, 0.46)),
    View("lounge", (Seat("yellow"),), -20.0, 1.45, 37.9, "lamps", exif=False, portrait=True, tiles=(0.22, 0.15, 0.1)),
)  # fmt: skip


def generate(out: Path, seed: int, lat_longs: Sequence[Path], parameters: Parameters, progress: Progress) -> None:
    """Write the data set into the empty folder `out`; `lat_longs` (maps of the user's) replace the made surroundings."""
    for name in ("photos", "masks", "meshes", "truth"):
        (out / name).mkdir(parents=True)
    rng = np.random.default_rng([11, seed])
    materials = drawn_materials(rng, 0.0 if seed == 0 else 0.15, MATERIALS)
    folder.write_obj(out / "meshes/chair.obj", {name: (mesh.vertices, mesh.faces) for name, mesh in parts(GIVEN).items()})
    photos, poses = [], {}
    for number, view in enumerate(VIEWS):
        progress(2 * number, 2 * len(VIEWS), f"light of {view.name}")
        view = view if seed == 0 else moved(view, rng)
        maps = far_map(view, lat_longs[number % len(lat_longs)] if lat_longs else None, rng, parameters)
        progress(2 * number + 1, 2 * len(VIEWS), f"photo {view.name}")
        entry, poses[view.name] = write_view(out, view, maps, materials, parameters, 100 * seed + number)
        photos.append(entry)
    write_records(out, materials, photos, poses)
    progress(2 * len(VIEWS), 2 * len(VIEWS), "done")


def moved(view: View, rng: np.random.Generator) -> View:
    """The view from elsewhere, with the chairs turned otherwise and another lens."""
    seats = tuple(msgspec.structs.replace(seat, turn_deg=seat.turn_deg + rng.uniform(-40, 40)) for seat in view.seats)
    return msgspec.structs.replace(
        view, seats=seats, azimuth_deg=view.azimuth_deg + rng.uniform(-30, 30), height=view.height * rng.uniform(0.9, 1.1),
        film_mm=view.film_mm * rng.uniform(0.9, 1.1),
    )  # fmt: skip


def far_map(view: View, captured: Path | None, rng: np.random.Generator, parameters: Parameters) -> Float[np.ndarray, "h w 3"]:
    """What surrounds the scene at infinity, in the world's frame."""
    seed = int(rng.integers(1 << 24))
    if captured is not None:
        return lights.captured(captured, parameters.light_rows)
    return lights.map_of(surroundings(view, rng), np.eye(3), parameters.far_rows, parameters.light_spp, seed)


def surroundings(view: View, rng: np.random.Generator) -> Things:
    """A sky or a room by its name; suns stand where photographers like them, to a side behind the camera."""
    sun = view.azimuth_deg + rng.choice([-1, 1]) * rng.uniform(30, 70)
    made = {
        "noon": lambda: lights.daylight(rng, 52, sun, turbidity=3.0),
        "evening": lambda: lights.daylight(rng, 17, sun, turbidity=6.0),
        "overcast": lambda: lights.daylight(rng, 40, sun, turbidity=9.0, sun_scale=0.01, sun_aperture_deg=12.0),
        "room": lambda: lights.room(rng, windows=2, lamps=2),
        "windows": lambda: lights.room(rng, windows=3, lamps=0),
        "lamps": lambda: lights.room(rng, windows=1, lamps=3),
    }
    return made[view.surroundings]()


def write_view(out: Path, view: View, far, materials: dict[str, Material], parameters: Parameters, seed: int) -> tuple[dict, dict[str, Pose]]:
    """Trace, expose and write one photo with its masks and truth; its entry in dataset.yaml and the poses."""
    camera = camera_of(view, parameters)
    world_from_camera = placed_camera(view, camera)
    poses = {seat.colour: pose_of(seat, view, world_from_camera) for seat in view.seats}
    meshes = [labelled(seat, list(materials)) for seat in view.seats]
    labels = folder.labels_of(meshes, camera, list(poses.values()))
    ground = {"far": loaded(envmap(far)), "ground": tiled(view)}
    radiance = photographed(ground | chairs(view, poses, materials, world_from_camera), camera, world_from_camera, parameters.spp, seed)
    exposure = exposure_of(radiance, (labels > 0) & (labels < folder.LEFT_OUT))
    turn = world_from_camera[:3, :3] @ YUP_FROM_CAMERA
    light = light_seen(ground, SEAT, turn, parameters.light_rows, parameters.light_spp, seed)
    folder.write_photo(out / f"photos/{view.name}.jpg", radiance * exposure, view.film_mm if view.exif else None)
    folder.write_labels(out / f"masks/{view.name}.png", labels)
    for seat, inside in zip(view.seats, folder.object_masks(meshes, camera, list(poses.values())), strict=True):
        folder.write_labels(out / f"masks/{view.name}_{seat.colour}.png", 255 * inside)
    folder.write_light(out / f"truth/{view.name}_light.exr", light * exposure)
    folder.write_normals(out / f"truth/{view.name}_normal.exr", rasterise(meshes, camera, list(poses.values())).normal)
    return entry(view), {f"{name}_chair": pose for name, pose in poses.items()}


def camera_of(view: View, parameters: Parameters) -> Camera:
    width, height = parameters.size, parameters.size * 3 // 4
    width, height = (height, width) if view.portrait else (width, height)
    focal = view.film_mm / folder.FILM_DIAGONAL * float(np.hypot(width, height))
    return Camera(width, height, focal, (width / 2, height / 2))


def placed_camera(view: View, camera: Camera) -> Float[np.ndarray, "4 4"]:
    """world_from_camera at the view's azimuth and height, as near as lets the chairs fill the frame."""
    points = np.concatenate([chair(GIVEN).vertices @ turned(seat, view)[:3, :3].T + turned(seat, view)[:3, 3] for seat in view.seats])
    distance = 3.0
    for _ in range(20):
        world_from_camera = standing(view, distance)
        pixels = camera.project((points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3])
        reach = np.abs(pixels / [camera.width / 2, camera.height / 2] - 1).max()
        distance *= 1 + 0.7 * (reach / FILLS - 1)
    return world_from_camera


def standing(view: View, distance: float) -> Float[np.ndarray, "4 4"]:
    """A camera that looks at the seats from the view's azimuth and height, `distance` metres away along the ground."""
    azimuth = np.radians(view.azimuth_deg)
    place = np.array([distance * np.sin(azimuth), view.height, distance * np.cos(azimuth)])
    pitch = -np.degrees(np.arctan2(view.height - SEAT[1], distance))
    return rigid(look(pitch, view.azimuth_deg + 180), place)


def turned(seat: Seat, view: View) -> Float[np.ndarray, "4 4"]:
    """world_from_object of a chair: beside the axis of the view, and turned."""
    azimuth = np.radians(view.azimuth_deg)
    right, nearer = np.array([np.cos(azimuth), 0, -np.sin(azimuth)]), np.array([np.sin(azimuth), 0, np.cos(azimuth)])
    turn = rotation_of_vector(np.array([0, np.radians(seat.turn_deg), 0]))
    return rigid(turn, seat.right * right + seat.nearer * nearer)


def pose_of(seat: Seat, view: View, world_from_camera: Float[np.ndarray, "4 4"]) -> Pose:
    cam_from_object = np.linalg.inv(world_from_camera) @ turned(seat, view)
    return Pose(cam_from_object[:3, :3], cam_from_object[:3, 3])


def labelled(seat: Seat, order: list[str]) -> Mesh:
    """The rendered chair, labelled by the set's materials."""
    mesh = chair(RENDERED)
    label = np.where(mesh.face_label == SHELL, order.index(seat.colour) + 1, order.index("wood") + 1)
    return msgspec.structs.replace(mesh, face_label=label.astype(np.int16))


def chairs(view: View, poses: dict[str, Pose], materials: dict[str, Material], world_from_camera) -> Things:
    things = {}
    for seat in view.seats:
        pose = poses[seat.colour]
        world = world_from_camera @ rigid(pose.rotation, pose.translation)
        for name, part, material in (("shell", SHELL, seat.colour), ("legs", LEGS, "wood")):
            things[f"{seat.colour}_{name}"] = shape(submesh(chair(RENDERED), part), bsdf(materials[material]), world)
    return things


def tiled(view: View, tile: float = 0.6, reach: float = 60.0) -> dict[str, Any]:
    """The ground: large tiles of two near shades."""
    shades = [rgb(np.array(view.tiles) * shade) for shade in (1.05, 0.92)]
    scale = transform(np.diag([reach / tile, reach / tile, 1.0, 1.0]))
    pattern = {"type": "checkerboard", "color0": shades[0], "color1": shades[1], "to_uv": scale}
    flat = np.array([[reach, 0, 0, 0], [0, 0, 1, 0], [0, -reach, 0, 0], [0, 0, 0, 1.0]])  # the square's +z to +y
    return {"type": "rectangle", "to_world": transform(flat), "bsdf": {"type": "diffuse", "reflectance": pattern}}


def loaded(thing: dict[str, Any]):
    """A Mitsuba object made once and shared by scenes."""
    from factorlib.generate.mitsuba_variant import mitsuba

    return mitsuba().load_dict(thing)


def photographed(things: Things, camera: Camera, world_from_camera, spp: int, seed: int) -> Float[np.ndarray, "h w 3"]:
    """All bounces."""
    return traced(things, camera, world_from_camera, spp, seed, max_depth=-1)


def exposure_of(radiance: Float[np.ndarray, "h w 3"], on_chair: Bool[np.ndarray, "h w"]) -> float:
    """What a camera's meter does: the mean luminance to grey, less where too much of the chairs would clip."""
    grey = GREY / np.minimum(radiance @ LUMINANCE, 4 * np.median(radiance @ LUMINANCE)).mean()
    return float(min(grey, 1 / np.quantile(radiance[on_chair].max(axis=-1), 1 - MOST_CLIPPED)))


def entry(view: View) -> dict:
    """The photo in dataset.yaml."""
    objects = [
        {"name": f"{seat.colour}_chair", "mesh": "chair", "materials": {"shell": seat.colour}, "mask": f"masks/{view.name}_{seat.colour}.png"}
        for seat in view.seats
    ]
    return {"name": view.name, "image": f"photos/{view.name}.jpg", "masks": f"masks/{view.name}.png", "objects": objects}


def write_records(out: Path, materials: dict[str, Material], photos: list[dict], poses: dict[str, dict[str, Pose]]) -> None:
    """dataset.yaml and truth/truth.yaml."""
    first = next(iter(materials))
    meshes = {"chair": {"file": "meshes/chair.obj", "parts": {"shell": first, "legs": "wood"}}}
    record = {"format": 1, "materials": list(materials), "meshes": meshes, "photos": photos, "truth": "truth/truth.yaml"}
    folder.write_yaml(out / "dataset.yaml", record, "Rendered, after the paper's protocol: python -m factorlib.generate eames")
    truth = {
        "materials": {name: msgspec.to_builtins(material) for name, material in materials.items()},
        "illumination": {name: f"truth/{name}_light.exr" for name in poses},
        "normals": {name: f"truth/{name}_normal.exr" for name in poses},
        "poses": {photo: {name: folder.pose_entry(pose) for name, pose in each.items()} for photo, each in poses.items()},
    }
    folder.write_yaml(out / "truth/truth.yaml", truth, "What the photos were made of; light at the seats, in the units of the photos")
