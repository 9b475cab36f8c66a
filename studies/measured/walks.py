"""Walks around a thing of several colours, as strangers take them: `python -m studies.measured.walks FOLDER …`.

The folders hold the light maps of `WALKS`.  A walk is `PHOTOS` cut-outs of one solid in one captured light, two of
them a hard sun's, with cameras (transforms.json).  `make photos` and `make all` do the rest.  Proposed parts are
matched with the true materials by the pixels that they share, and `evaluate` compares materials and light.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import yaml
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.schema import LEFT_OUT
from factorlib.errors import InputError
from factorlib.generate.folder import label_pixels, write_light, write_yaml
from factorlib.generate.paint import print_pattern
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import unit
from factorlib.images.exr import encode_pixels, read_rgb_exr
from factorlib.images.light_map import maps_in, read_light_map
from factorlib.images.picture import read_png
from factorlib.images.tone import srgb_encode
from factorlib.jsonfile import write_json
from factorlib.light.latlong import sample_map
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import submesh
from factorlib.meshes.subdivision import subdivide
from factorlib.results.materials import Reflectance
from factorlib.scenes.bodies import bumpy_ball, jug, mesh_from_parts, stack
from factorlib.tracing.scene import envmap, painted_shape, render_scene, rigid, sensor
from factorlib.wholefile import write_bytes, write_text
from studies.measured.tools import ROOT, evaluate_dataset, machine, markdown_table, run_verb

PLACE = ROOT / "build/bench/walks"
PHOTOS = 12
SIZE = 512  # pixels of a side
FOCAL = 1000.0
DISTANCE = 2.6  # of the camera, in extents of the solid
CLIPPED = 0.005  # share of the thing's pixels whose brightest channel is clipped
SAMPLES = 64
LIGHT_ROWS = 128
FINER = 2  # nodes of Mitsuba's map per row of the light
BRIGHTEST = np.radians(5)  # radius of a light's brightest region
SUN_RADIUS = np.radians(15)  # about a sun's direction; what lies within is compared with the true light there
MATERIALS = {
    "cream": Reflectance((0.62, 0.56, 0.46), (0.05, 0.05, 0.05), 0.25),
    "red": Reflectance((0.42, 0.05, 0.04), (0.035, 0.035, 0.035), 0.35),
    "blue": Reflectance((0.04, 0.10, 0.32), (0.04, 0.04, 0.04), 0.5),
    "green": Reflectance((0.10, 0.25, 0.06), (0.03, 0.03, 0.03), 0.3),
}


class Walk(NamedTuple):
    """A solid with its materials by position, the map that lights it, and the label that is painted, if any."""

    solid: Callable[[], Mesh]
    light: str
    sun: bool = False
    painted: int | None = None


def regions(mesh: Mesh, label_of: Callable[[Float[np.ndarray, "f 3"]], np.ndarray]) -> Mesh:
    """Return the mesh with the labels of its faces' centres."""
    fine = subdivide(mesh, 0.03)
    return msgspec.structs.replace(fine, face_label=label_of(fine.vertices[fine.faces].mean(1)))


def three_part_jug() -> Mesh:
    """Return the jug with a coloured foot: body cream, handle and spout red, foot blue."""
    mesh = mesh_from_parts(jug(), "jug")
    fine = subdivide(mesh, 0.03)
    low = fine.vertices[fine.faces].mean(1)[:, 1] < -0.22
    return msgspec.structs.replace(fine, face_label=np.where((fine.face_label == 1) & low, 3, fine.face_label))


def four_part_ball() -> Mesh:
    """Return the bumpy ball in four regions about as large."""
    axes = unit(np.array([[0, 1, 0.2], [0.9, -0.3, -0.5], [-0.9, -0.4, -0.4], [0.1, -0.3, 1.0]]))
    return regions(mesh_from_parts(bumpy_ball(), "ball"), lambda centre: 1 + np.argmax(centre @ axes.T, axis=1))


def three_boxes() -> Mesh:
    """Return the stack, each box of a colour."""
    parts = [(vertices, faces, label) for label, (vertices, faces, _) in enumerate(stack(), start=1)]
    return mesh_from_parts(parts, "boxes")


def halved_ball() -> Mesh:
    """Return the bumpy ball in three regions, of which the first is painted."""
    axes = unit(np.array([[0, 1, 0.3], [0.8, -0.6, -0.2], [-0.8, -0.6, -0.1]]))
    return regions(mesh_from_parts(bumpy_ball(), "ball"), lambda centre: 1 + np.argmax(centre @ axes.T, axis=1))


WALKS = {
    "jug": Walk(three_part_jug, "chinese_garden", sun=True),
    "ball": Walk(four_part_ball, "brown_photostudio_02"),
    "boxes": Walk(three_boxes, "modern_buildings_2", sun=True),
    "printed": Walk(halved_ball, "leadenhall_market", painted=1),
}


def walk_cameras() -> list[tuple[Camera, Float[np.ndarray, "4 4"]]]:
    """Return the camera of each photo with world_from_camera, on a wavy circle about the origin; world: y up."""
    cameras = []
    for number in range(PHOTOS):
        azimuth = 2 * np.pi * number / PHOTOS
        height = np.radians(22 + 16 * np.sin(2.5 * azimuth))
        place = DISTANCE * np.array(
            [np.cos(height) * np.sin(azimuth), np.sin(height), np.cos(height) * np.cos(azimuth)]
        )
        forward = -unit(place[None])[0]
        right = unit(np.cross(forward, [0.0, 1.0, 0.0])[None])[0]
        rotation = np.column_stack([right, np.cross(forward, right), forward])
        cameras.append((Camera(SIZE, SIZE, FOCAL, (SIZE / 2, SIZE / 2)), rigid(rotation, place)))
    return cameras


def generate_walk(name: str, folders: Sequence[Path]) -> Path:
    """Return the folder of a walk's photos, with transforms.json and truth; render it if it is missing."""
    folder = PLACE / f"{name}-photos"
    if folder.exists():
        return folder
    walk = WALKS[name]
    light = light_map(walk.light, folders)
    mesh = walk.solid()
    mesh = msgspec.structs.replace(mesh, vertices=mesh.vertices - (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2)
    if walk.painted:
        mesh = painted_mesh(mesh, walk.painted)
    unfinished = folder.with_suffix(".new")
    shutil.rmtree(unfinished, ignore_errors=True)
    (unfinished / "truth").mkdir(parents=True)
    around: dict[str, Any] = {"light": envmap(light, FINER)}
    for label, material in zip(mesh.labels, MATERIALS.values(), strict=False):
        around[f"part_{label}"] = painted_shape(submesh(mesh, label), material)
    frames = []
    pictures = []
    for number, (camera, world_from_camera) in enumerate(walk_cameras()):
        view = sensor(camera, world_from_camera, alpha=True)
        pictures.append(render_scene(around, view, SAMPLES, number, -1, hide_emitters=True))
        rotation = world_from_camera[:3, :3].T
        labels = label_pixels([mesh], camera, [Pose(rotation, -rotation @ world_from_camera[:3, 3])])
        write_bytes(unfinished / f"truth/{number:02}.png", encode_pixels("l.png", labels.astype(np.uint8)[..., None]))
        opengl = world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{number:02}", "transform_matrix": opengl.tolist()})
        print(f"{name}: photo {number + 1} of {PHOTOS}", flush=True)
    shown = np.concatenate([picture[picture[..., 3] > 0.99][:, :3].max(1) for picture in pictures])
    exposure = float(1 / np.quantile(shown, 1 - CLIPPED))
    for number, picture in enumerate(pictures):
        alpha = picture[..., 3:].clip(0, 1)
        straight = picture[..., :3] / np.maximum(alpha, 1e-3)
        pixels = np.concatenate([srgb_encode(np.clip(straight * exposure, 0, 1)), alpha], axis=-1)
        coded = (255 * pixels + 0.5).astype(np.uint8)
        write_bytes(unfinished / f"{number:02}.png", encode_pixels("photo.png", coded))
    write_light(unfinished / "truth/light.exr", light * exposure)
    angle = 2 * float(np.arctan(SIZE / 2 / FOCAL))
    write_json(unfinished / "transforms.json", {"camera_angle_x": angle, "frames": frames})
    unfinished.rename(folder)
    return folder


def light_map(name: str, folders: Sequence[Path]) -> Float[np.ndarray, "h w 3"]:
    """Return the captured light of this name at `LIGHT_ROWS` rows, with a mean radiance of 1."""
    if not (found := [path for path in maps_in(folders) if path.stem == name]):
        raise InputError(f"no map is called {name}", key="FOLDER", cure="name the folder that holds it")
    radiance = read_light_map(found[0])
    rows = len(radiance) // LIGHT_ROWS
    radiance = radiance.reshape(LIGHT_ROWS, rows, 2 * LIGHT_ROWS, rows, 3).mean(axis=(1, 3))
    return radiance / radiance.mean()


def painted_mesh(mesh: Mesh, label: int) -> Mesh:
    """Return the mesh with a print on the faces of one label."""
    fine = subdivide(mesh, 0.012)
    used = np.unique(fine.faces[fine.face_label == label])
    detail = np.ones_like(fine.vertices)
    factor = np.exp(print_pattern(np.random.default_rng(3), fine.vertices[used]))
    detail[used] = np.minimum(factor / factor.mean(0), 1 / 0.65)
    return msgspec.structs.replace(fine, detail=detail)


def import_walk(name: str, photos: Path) -> tuple[Path, Float[np.ndarray, "p m"]]:
    """Return the data set that `make photos` makes of a walk, with its truth, and overlaps of parts and materials."""
    dataset = PLACE / name
    if not (dataset / "dataset.yaml").exists():
        run_verb("photos", dataset, PHOTOS=str(photos))
    declared = yaml.safe_load((dataset / "dataset.yaml").read_text(encoding="utf-8"))
    labels = [read_png(dataset / photo["masks"])[..., 0] for photo in declared["photos"]]
    truth = [read_png(photos / f"truth/{photo['name']}.png")[..., 0] for photo in declared["photos"]]
    overlaps = overlap(labels, truth)
    matched = dict(zip(*linear_sum_assignment(-overlaps), strict=True))
    materials = list(MATERIALS)
    known = {
        declared["materials"][part]: msgspec.to_builtins(MATERIALS[materials[own]]) for part, own in matched.items()
    }
    # world of the data set from that of the walk
    first = read_dataset(dataset).spec.photos[0]
    turn = np.array(first.world_from_camera) @ walk_cameras()[0][1][:3, :3].T
    light = read_rgb_exr(photos / "truth/light.exr")
    directions = lat_long_directions(*light.shape[:2]) @ YUP_FROM_CAMERA @ turn
    (dataset / "truth").mkdir(exist_ok=True)
    write_light(dataset / "truth/room.exr", sample_map(light, directions))
    illumination = {first.illumination: "truth/room.exr"}
    write_yaml(dataset / "truth/truth.yaml", {"materials": known, "illumination": illumination}, "of a made walk")
    if "truth" not in declared:
        file = dataset / "dataset.yaml"
        write_text(file, file.read_text(encoding="utf-8") + "truth: truth/truth.yaml\n")
    return dataset, overlaps


def overlap(
    labels: Sequence[Int[np.ndarray, "h w"]], truth: Sequence[Int[np.ndarray, "h w"]]
) -> Float[np.ndarray, "p m"]:
    """Return intersection over union of each proposed part and each material, over all photos but left-out pixels."""
    part, own = (np.concatenate([picture.reshape(-1) for picture in pictures]) for pictures in (labels, truth))
    known = (part != LEFT_OUT) & (own != LEFT_OUT)
    part = part[known]
    own = own[known]

    def iou(k: int, m: int) -> float:
        """Return the overlap of a part and a material."""
        return float(((part == k) & (own == m)).sum() / ((part == k) | (own == m)).sum())

    return np.array([[iou(k, m) for m in range(1, own.max() + 1)] for k in range(1, part.max() + 1)])


def sun_errors(estimate: Path, truth: Path) -> tuple[float, float]:
    """Return how well a light has the sun of the true one.

    Args:
        estimate: Exported light.
        truth: True light.

    Returns:
        Angle between their brightest directions, degrees, and the share of the light within `SUN_RADIUS` of the true
        one, over the true share.
    """
    maps = [read_rgb_exr(path).mean(2) for path in (estimate, truth)]
    directions = lat_long_directions(*maps[0].shape).reshape(-1, 3)
    area = np.repeat(lat_long_solid_angles(*maps[0].shape), maps[0].shape[1])
    energies = [radiance.reshape(-1) * area / (radiance.reshape(-1) @ area) for radiance in maps]
    tops = []
    for energy in energies:
        near = directions @ directions[np.argmax(energy / area)] > np.cos(BRIGHTEST)
        tops.append(unit((energy[near] @ directions[near])[None])[0])
    within = directions @ tops[1] > np.cos(SUN_RADIUS)
    angle = float(np.degrees(np.arccos(np.clip(tops[0] @ tops[1], -1, 1))))
    return angle, float(energies[0][within].sum() / energies[1][within].sum())


def row_of(name: str, folders: Sequence[Path]) -> list[str]:
    """Make, import and solve a walk, and return its row of the table."""
    dataset, overlaps = import_walk(name, generate_walk(name, folders))
    metrics = evaluate_dataset(dataset)
    build = ROOT / "build" / name
    errors = [material["error"] for material in metrics["materials"]["materials"].values()]
    angle, share = sun_errors(next((build / "export/illumination").glob("*.exr")), dataset / "truth/room.exr")
    return [
        f"{name}, {WALKS[name].light}",
        f"{len(overlaps)} of {overlaps.shape[1]}",
        ", ".join(f"{best:.2f}" for best in overlaps.max(0)),
        f"{metrics['relit_set']['mean_psnr_db']:.1f} ({metrics['relit_set']['worst_psnr_db']:.1f})",
        ", ".join(f"{100 * np.abs(error['diffuse']).mean():.0f}" for error in errors),
        ", ".join(f"{error['roughness']:.2f}" for error in errors),
        f"{angle:.1f}°, {share:.2f}" if WALKS[name].sun else "",
    ]


def main() -> None:
    """Print the table of the walks that are named, or of all."""
    names = [word for word in sys.argv[1:] if word in WALKS] or list(WALKS)
    folders = [Path(word) for word in sys.argv[1:] if word not in WALKS]
    head = ["walk, light", "parts", "IoU", "relit (worst), dB", "k_d, %", "roughness", "sun: angle, share of the true"]
    print(machine())
    print(markdown_table(head, [row_of(name, folders) for name in names]))


if __name__ == "__main__":
    main()
