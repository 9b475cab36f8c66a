"""A large set in little time: photos of a row of balls, each of one of many materials, in a light of a few lobes.

A ball's normals are known in closed form and its radiance is that of the model (`factorlib.reflection`), so a photo takes milliseconds.
Materials and lights are linked at random: with 1,000 photos of 5 out of 100 materials, each material stands in 50 lights.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float

from factorlib.dataset.schema import TrueMaterial
from factorlib.generate.folder import write_labels, write_photo, write_yaml
from factorlib.light.lobes import Lobes
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import write_ply
from factorlib.reflection import reflection_operator

BALLS, RADIUS, PITCH = 5, 10, 24  # in a photo; pixels; pixels from centre to centre
FOCAL, DISTANCE = 400.0, 40.0  # a ball of radius 1 there is RADIUS pixels wide
WIDTH, HEIGHT = PITCH * BALLS, PITCH
LOBES, SHARPNESS = (3, 12), (2.0, 200.0)  # how many in a light; log-uniform
GRAZING = 0.2  # least n·o of what is labelled: the mesh's silhouette is not the ball's
UPRIGHT = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


class Ball(NamedTuple):
    """Pixels that show a ball: where they are in its square, and the unit normals and directions to the camera, camera frame."""

    inside: Bool[np.ndarray, "s s"]
    normal: Float[np.ndarray, "n 3"]
    view: Float[np.ndarray, "n 3"]


def write_set(folder: Path, photos: int, materials: int, seed: int = 0) -> None:
    """Write dataset.yaml with its photos, masks, mesh and true materials; the same bytes for the same arguments."""
    rng, operator = np.random.default_rng(seed), reflection_operator("network")
    for name in ("photos", "masks", "meshes", "truth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    coarse = trimesh.creation.icosphere(subdivisions=3)
    corners, faces = np.asarray(coarse.vertices), np.asarray(coarse.faces, dtype=np.int32)
    write_ply(folder / "meshes" / "ball.ply", Mesh(corners, faces, corners, np.ones(len(faces), dtype=np.int16)))
    names = [f"m{k:03d}" for k in range(materials)]
    true = {name: drawn_material(rng) for name in names}
    shown = [rng.choice(materials, size=min(BALLS, materials), replace=False).tolist() for _ in range(photos)]
    entries, balls = [], [ball_at(place) for place in range(BALLS)]
    for number, some in enumerate(shown):
        photo, light = f"p{number:06d}", drawn_light(rng)
        radiance, label = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.zeros((HEIGHT, WIDTH), np.uint8)
        for place, (ball, m) in enumerate(zip(balls, some)):
            columns = slice(place * PITCH, (place + 1) * PITCH)
            with torch.no_grad():
                radiance[:, columns][ball.inside] = operator(light, true[names[m]], ball.normal, ball.view).numpy()
            label[:, columns][ball.inside] = m + 1
        write_photo(folder / "photos" / f"{photo}.exr", radiance)
        write_labels(folder / "masks" / f"{photo}.png", label)
        poses = [{"rotation": UPRIGHT, "translation": [centre_of(k), 0.0, DISTANCE]} for k in range(len(some))]
        objects = [{"name": f"ball{k}", "mesh": names[some[k]], "pose": pose} for k, pose in enumerate(poses)]
        files = {"image": f"photos/{photo}.exr", "masks": f"masks/{photo}.png"}
        entries.append({"name": photo, **files, "camera": {"focal_px": FOCAL}, "objects": objects})
    truth = {"materials": {name: msgspec.to_builtins(material) for name, material in true.items()}}
    write_yaml(folder / "truth" / "truth.yaml", truth, "What the photos were made of")
    meshes = {name: {"file": "meshes/ball.ply", "material": name} for name in names}
    record = {"format": 1, "materials": names, "meshes": meshes, "photos": entries, "truth": "truth/truth.yaml"}
    write_yaml(folder / "dataset.yaml", record, f"Generated: {photos} photos of {materials} materials, seed {seed}")


def drawn_material(rng: np.random.Generator) -> TrueMaterial:
    """A material with k_d + k_s < .9 and roughness between .15 and .7."""
    return TrueMaterial(
        tuple(rng.uniform(0.05, 0.6, 3).tolist()), (float(rng.uniform(0.03, 0.3)),) * 3, float(rng.uniform(0.15, 0.7))
    )


def drawn_light(rng: np.random.Generator) -> Lobes:
    """A few lobes in random directions, one of them broad, of mean radiance about 1."""
    count = int(rng.integers(*LOBES, endpoint=True))
    axis = rng.normal(size=(count, 3))
    sharpness = np.exp(rng.uniform(*np.log(SHARPNESS), count))
    sharpness[0] = 0.5
    energy = rng.uniform(0.3, 1.0, (count, 1)) * rng.uniform(0.6, 1.0, (count, 3))
    weight = energy * np.maximum(sharpness, 1.0)[:, None] / count
    return Lobes(axis / np.linalg.norm(axis, axis=1, keepdims=True), sharpness, weight)


def ball_at(place: int) -> Ball:
    """The ball of a place in the row; its centre is at (x, 0, DISTANCE)."""
    centre = np.array([centre_of(place), 0.0, DISTANCE])
    y, x = np.mgrid[:HEIGHT, place * PITCH : (place + 1) * PITCH] + 0.5
    ray = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = ray @ centre
    short = along**2 - (centre @ centre - 1.0)
    normal = ray * (along - np.sqrt(np.maximum(short, 0)))[..., None] - centre
    inside = (short > 0) & ((normal * -ray).sum(-1) > GRAZING)
    return Ball(inside, normal[inside], -ray[inside])


def centre_of(place: int) -> float:
    """x of a ball's centre, in radii."""
    return (place - (BALLS - 1) / 2) * PITCH * DISTANCE / FOCAL
