"""The set: photographed shapes whose pose is known, and photos that no pose can be right for.

    exact      the mesh that was photographed                   rough          500 triangles, warped by 3 %
    wrong mesh      the mesh of another shape                   wrong mask     a random blot where the object was
    mirrored mask   left and right exchanged                    tiny mask      the object so far away that some 20 pixels show it

Rotations are uniform over SO(3), focal lengths log-uniform (`FOCALS`), sizes and places uniform where the frame cuts nothing.
`python -m benchmarks.align.cases FOLDER [--views 4 --seeds 1]` writes a set as a dataset that `make align DATASET=FOLDER` reads.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
import yaml
from jaxtyping import Int
from scipy.spatial.transform import Rotation

from benchmarks.align import shapes
from factorlib.generate.folder import write_labels, write_obj, write_photo
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Maps, rasterise
from factorlib.meshes.mesh import Mesh

WIDTH, HEIGHT = 640, 480
FOCALS = (0.8, 2.5)  # of the width
FILLS = (0.5, 0.9)  # bounding sphere's diameter in the image, of the height
TINY_FILL = 0.015
RIGHT, WRONG = ("exact", "rough"), ("wrong mesh", "wrong mask", "mirrored mask", "tiny mask")


class Case(msgspec.Struct, frozen=True):
    """A photo of `shape` at a known pose; `label` is the mask that is given with mesh `given` (shape, or seed of a rough one)."""

    kind: str
    shape: str
    seed: int
    number: int
    camera: Camera
    pose: Pose
    label: Int[np.ndarray, "h w"]
    given: str
    rough: bool

    @property
    def name(self) -> str:
        return f"{self.kind.replace(' ', '_')}-{self.shape}-{self.seed}-{self.number}"

    def given_mesh(self) -> Mesh:
        return shapes.rough(self.given, self.seed) if self.rough else shapes.mesh(self.given)

    def truth(self) -> Maps:
        return rasterise(shapes.mesh(self.shape), self.camera, self.pose)


def keys(views: int, seeds: int, kinds: tuple[str, ...], wrong_views: int) -> list[tuple[str, str, int, int]]:
    """(kind, shape, seed, number): `views` of each shape and right kind, `wrong_views` of each wrong kind, for each seed.

    >>> len(keys(20, 3, ("exact", "tiny mask"), 2))
    330
    """
    counts = {kind: views if kind in RIGHT else wrong_views for kind in kinds}
    return [
        (kind, shape, seed, n)
        for kind in kinds
        for seed in range(seeds)
        for shape in shapes.SHAPES
        for n in range(counts[kind])
    ]


def case(kind: str, shape: str, seed: int, number: int) -> Case:
    rng = np.random.default_rng(zlib.crc32(f"{kind} {shape} {seed} {number}".encode()))
    camera, pose, label = photographed(
        shapes.mesh(shape), rng, TINY_FILL if kind == "tiny mask" else rng.uniform(*FILLS)
    )
    given = shape
    if kind == "mirrored mask":
        label = label[:, ::-1]
    if kind == "wrong mask":
        label = blot(label, shapes.mesh(shape).labels, rng)
    if kind == "wrong mesh":
        given = str(rng.choice([other for other in shapes.SHAPES if other != shape]))
        label = np.minimum(label, max(shapes.mesh(given).labels))
    return Case(kind, shape, seed, number, camera, pose, np.ascontiguousarray(label), given, kind == "rough")


def photographed(mesh: Mesh, rng: np.random.Generator, fill: float) -> tuple[Camera, Pose, np.ndarray]:
    """A camera, a pose that the frame does not cut, and the labels seen."""
    focal = WIDTH * float(np.exp(rng.uniform(*np.log(FOCALS))))
    camera = Camera(WIDTH, HEIGHT, focal, (WIDTH / 2, HEIGHT / 2))
    rotation = Rotation.random(rng=rng).as_matrix()
    while True:
        depth = 2 * focal * mesh.radius / (fill * HEIGHT)
        place = rng.uniform(-0.5, 0.5, 2) * (WIDTH, HEIGHT) / focal
        pose = Pose(rotation, depth * np.array([*place, 1.0]) - rotation @ mesh.centre)
        label = rasterise(mesh, camera, pose).label
        rim = np.concatenate([label[:2].ravel(), label[-2:].ravel(), label[:, :2].ravel(), label[:, -2:].ravel()])
        if label.any() and not rim.any():
            return camera, pose, label


def blot(label: np.ndarray, labels: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """A star-shaped region of about the mask's area about its middle, with a straight border between its materials."""
    rows, columns = np.nonzero(label)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    y, x = y - rows.mean(), x - columns.mean()
    angle, order = np.arctan2(y, x), np.arange(1, 6)[:, None, None]
    wave = np.sum(
        rng.normal(0, 0.35, (5, 1, 1)) / order**0.5 * np.sin(order * angle + rng.uniform(0, 6.3, (5, 1, 1))), axis=0
    )
    inside = np.hypot(x, y) < np.sqrt(len(rows) / np.pi) * np.exp(wave)
    turn = rng.uniform(0, 2 * np.pi)
    return np.where(inside, np.where(np.cos(turn) * x + np.sin(turn) * y > 0, labels[-1], labels[0]), 0)


def write_set(folder: Path, made: list[Case]) -> None:
    """dataset.yaml with truth; pictures are the normals under a lamp at the camera."""
    for name in ("photos", "masks", "meshes", "truth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    meshes, photos, poses = {}, [], {}
    for each in made:
        mesh, mesh_name = (
            each.given_mesh(),
            f"{'rough_' if each.rough else ''}{each.given}{each.seed if each.rough else ''}",
        )
        parts = {f"part{k}": (mesh.vertices, mesh.faces[mesh.face_label == k]) for k in mesh.labels}
        write_obj(folder / f"meshes/{mesh_name}.obj", parts)
        meshes[mesh_name] = {
            "file": f"meshes/{mesh_name}.obj",
            "parts": {f"part{k}": f"material{k}" for k in mesh.labels},
        }
        lit = np.clip(-each.truth().normal[..., 2:], 0.02, 1) * np.array([0.5, 0.45, 0.4])
        write_photo(folder / f"photos/{each.name}.png", lit)
        write_labels(folder / f"masks/{each.name}.png", each.label)
        obj = {"name": "object", "mesh": mesh_name}
        photos.append(
            {
                "name": each.name,
                "image": f"photos/{each.name}.png",
                "masks": f"masks/{each.name}.png",
                "illumination": "lamp",
                "objects": [obj],
            }
        )
        if each.kind in RIGHT:
            poses[each.name] = {
                "object": {"rotation": each.pose.rotation.tolist(), "translation": each.pose.translation.tolist()}
            }
    spec = {
        "format": 1,
        "materials": ["material1", "material2"],
        "meshes": meshes,
        "photos": photos,
        "truth": "truth/truth.yaml",
    }
    (folder / "truth/truth.yaml").write_text(yaml.safe_dump({"poses": poses}, sort_keys=False), encoding="utf-8")
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec, sort_keys=False), encoding="utf-8")


def main(
    folder: Annotated[Path, typer.Argument(help="folder of the dataset, made anew")],
    views: Annotated[int, typer.Option(help="photos of each shape and right kind")] = 4,
    seeds: Annotated[int, typer.Option(help="0 to this, less one")] = 1,
    wrong_views: Annotated[int, typer.Option(help="photos of each shape and wrong kind")] = 1,
) -> None:
    write_set(folder, [case(*key) for key in keys(views, seeds, RIGHT + WRONG, wrong_views)])


if __name__ == "__main__":
    typer.run(main)
