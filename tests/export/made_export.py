"""Small inputs of `export`, `render` and `recipes`, and a whole small result, made by hand.

The first photo shows a ball, principal point off centre; the second an ellipsoid of two materials far off the
axis, turned, in a light fixed to the world.  The meshes are fine enough that their facets do not show.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import write_exr
from factorlib.jsonfile import write_json
from factorlib.light.lobes import SUN, Lobes, lobe_energy
from factorlib.meshes.read_mesh import read_mesh
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs
from stages import export
from tests.stages.made import poses_of, ran, write_aligned, write_solution

NAMES = ["red", "brass", "unseen"]
MATERIALS = {
    "red": {"diffuse": [0.7, 0.2, 0.1], "specular": [0.3, 0.35, 0.4], "roughness": 0.35},  # max + max > 1
    "brass": {"diffuse": [0.0, 0.0, 0.0], "specular": [0.8, 0.6, 0.2], "roughness": 0.5},
    "unseen": {"diffuse": [0.1, 0.2, 0.5], "specular": [0.0, 0.0, 0.0], "roughness": 0.9},
}
WIDTH, HEIGHT = 64, 56
CAMERAS = {"front": Camera(WIDTH, HEIGHT, 95.0, (38.0, 25.0)), "side": Camera(WIDTH, HEIGHT, 85.0, (9.0, 42.0))}
POSES = {
    "front": Pose(np.eye(3), np.array([-0.2, 0.15, 4.0])),
    "side": Pose(Rotation.from_euler("xyz", [30, -50, 70], degrees=True).as_matrix(), np.array([1.1, -0.7, 4.0])),
}
MESHES, LIGHTS = {"front": "ball", "side": "egg"}, {"front": "front", "side": "room"}
PARTS = {"ball": {"upper": "red", "lower": "red"}, "egg": {"upper": "red", "lower": "brass"}}
WORLD_FROM_CAMERA = {"front": None, "side": Rotation.from_euler("xyz", [-25, 60, 15], degrees=True).as_matrix()}
SUN_DIRECTION = (0.6, -0.64, -0.48)  # in the camera frame
EXPOSURES = {"front": [1.0] * 3, "side": [0.5] * 3}


def light(seed: int) -> Lobes:
    """A sky, a window off the axis and a small lamp, of different colours, in front of the objects mostly."""
    rng = np.random.default_rng(seed)
    axis = np.array([[0.2, -0.9, -0.3], [-0.8, -0.3, -0.5], [0.6, 0.1, -0.8]]) + 0.1 * rng.normal(size=(3, 3))
    weight = np.array([[0.4, 0.6, 1.0], [2.0, 1.5, 1.0], [30.0, 10.0, 20.0]])
    return Lobes(axis / np.linalg.norm(axis, axis=1, keepdims=True), np.array([1.5, 12.0, 300.0]), weight)


def with_sun(lobes: Lobes, axis: tuple[float, float, float], irradiance: tuple[float, float, float]) -> Lobes:
    """The light with a sun beside it; axis: toward it, unit."""
    weight = np.array(irradiance) / lobe_energy(np.array([SUN]))
    return Lobes(np.vstack([lobes.axis, axis]), np.append(lobes.sharpness, SUN), np.vstack([lobes.weight, weight]))


def lights() -> dict[str, Lobes]:
    """By illumination, each in its own frame; a sun shines into the room."""
    room = with_sun(light(1), SUN_DIRECTION, (1.2, 1.0, 0.7))
    return {"front": light(0), "room": room.rotate(WORLD_FROM_CAMERA["side"])}


def write_obj(path: Path, radii: tuple[float, float, float], rows: int = 48) -> None:
    """An ellipsoid of two parts, `upper` and `lower`."""
    theta, phi = np.linspace(0, np.pi, rows + 1), np.arange(2 * rows) / rows * np.pi
    t, p = (a.reshape(-1) for a in np.meshgrid(theta, phi, indexing="ij"))
    points = np.stack([np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], axis=-1) * radii
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in points]
    for half, name in ((0, "upper"), (1, "lower")):
        lines.append(f"g {name}")
        for i in range(half * rows // 2, (half + 1) * rows // 2):
            for j in range(2 * rows):
                a, b = (1 + i * 2 * rows + k for k in (j, (j + 1) % (2 * rows)))
                c, d = a + 2 * rows, b + 2 * rows
                lines += [f"f {a} {b} {d}", f"f {a} {d} {c}"]
    path.write_text("\n".join(lines) + "\n")


def make(folder: Path) -> Inputs:
    """Write what `align`, `masks` and `solve` would, and return the inputs of `export`."""
    for stage in ("align", "masks", "solve", "meshes"):
        (folder / stage).mkdir(parents=True)
    files = {"ball.obj": folder / "meshes" / "ball.obj", "egg.obj": folder / "meshes" / "egg.obj"}
    write_obj(files["ball.obj"], (1, 1, 1))
    write_obj(files["egg.obj"], (0.8, 1.1, 0.6))
    facts, poses = {"dataset.materials": NAMES, "dataset.light": {}, "dataset.ground": {}, "dataset.objects": {}}, {}
    for photo, mesh in MESHES.items():
        world, camera, pose = WORLD_FROM_CAMERA[photo], CAMERAS[photo], POSES[photo]
        facts["dataset.light"][photo] = {
            "illumination": LIGHTS[photo],
            "world_from_camera": None if world is None else world.tolist(),
        }
        facts["dataset.ground"][photo] = {"ground": None}
        facts["dataset.objects"][photo] = {
            "camera": {},
            "objects": [{"name": "chair", "mesh": mesh}],
            "meshes": {mesh: {"file": f"{mesh}.obj", "parts": PARTS[mesh]}},
        }
        poses[photo] = poses_of(camera, chair=pose)
        maps = rasterise(read_mesh(files[f"{mesh}.obj"], NAMES, PARTS[mesh]), camera, pose)
        inside = maps.label > 0
        write_aligned(folder / "align", photo, maps)
        grey = {c: 0.3 * inside for c in "RGB"} | {"label": maps.label, "valid": inside, "left_out": 0 * inside}
        write_exr(folder / "masks" / f"{photo}.exr", grey)
    write_json(folder / "align" / "poses.json", poses)
    write_solution(folder / "solve", MATERIALS, lights(), EXPOSURES)
    return Inputs({stage: folder / stage for stage in ("align", "masks", "solve")}, facts, files)


def make_exported(folder: Path) -> Inputs:
    """The same, and what `export` makes of it, at a small size: the inputs of `recipes`."""
    inputs = make(folder)
    exported = ran(export, inputs, folder / "export", height=16, mitsuba_height=16)
    return Inputs({**inputs.folders, "export": exported}, inputs.facts, inputs.files)


@cache
def shared() -> tuple[Inputs, TemporaryDirectory]:
    """What `make_exported` returns, once for all tests of a session; who changes a file puts it back (`instead`)."""
    folder = TemporaryDirectory()
    return make_exported(Path(folder.name) / "set"), folder


@contextmanager
def instead(file: Path, write: Callable[[Path], object]) -> Iterator[None]:
    """The file is written anew, and put back afterwards."""
    before = file.read_bytes()
    try:
        write(file)
        yield
    finally:
        file.write_bytes(before)


def make_result(root: Path, name: str = "set") -> Path:
    """build/<name> of a checkout at `root` as the runner leaves it, beside its data set data/<name>."""
    build, dataset, photos = root / "build" / name, root / "data" / name, []
    inputs = make_exported(build)
    dataset.mkdir(parents=True)
    (build / "dataset.txt").write_text(f"data/{name}\n")
    for file, path in inputs.files.items():
        (dataset / file).write_bytes(path.read_bytes())
    for photo, mesh in MESHES.items():
        files = {"image": f"{photo}.png", "masks": f"{photo}_mask.png"}
        for file in files.values():
            (dataset / file).write_bytes(b"")
        photos.append({"name": photo, **files, "objects": [{"name": "chair", "mesh": mesh}]})
    photos[1] |= {"illumination": "room", "world_from_camera": WORLD_FROM_CAMERA["side"].tolist()}
    meshes = {mesh: {"file": f"{mesh}.obj", "parts": PARTS[mesh]} for mesh in MESHES.values()}
    write_json(dataset / "dataset.yaml", {"format": 1, "materials": NAMES, "meshes": meshes, "photos": photos})
    return build


def of_photo(inputs: Inputs, photo: str) -> Inputs:
    """Of what `make_exported` returns, the inputs of `render` for one photo; the networks are the shipped ones."""
    facts = {**inputs.facts, "dataset.light": inputs.facts["dataset.light"][photo]}
    return Inputs({**inputs.folders, "train": SHIPPED}, facts, inputs.files, photo)
