"""A set in one of the paper's observation patterns as a data set on disk: `python -m studies.sets FOLDER --set docksta [--seed 1]`.

What the study `paper-sets` solves straight from observations, written as photos, masks, meshes and truth, for the whole pipeline:
`make all DATASET=FOLDER`.  A photo shows its entries side by side, each a body of its own, seen from far away; poses and focal
length are given.  Radiance is that of the true normals in the light's map: no shadows, no light from body to body; photos are linear EXR.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError, did_you_mean
from factorlib.evaluate.ball import Light
from factorlib.generate.folder import (
    labels_of,
    pose_entry,
    write_exact_obj,
    write_labels,
    write_light,
    write_normals,
    write_photo,
    write_truth,
    write_yaml,
)
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.meshes.mesh import Mesh
from studies.catalogue.paper_sets import patterns
from studies.core.entries import Entry
from studies.core.objects.case import SEVEN
from studies.core.objects.world import BODIES, CAMERA, SIDE, body, body_of, materials_of, pose_of
from studies.core.observed import NOISE
from studies.core.study import FULL
from studies.core.world import light, light_map, spheres

COMMENT = "Made in an observation pattern of the paper: python -m studies.sets"


class Shot(msgspec.Struct, frozen=True):
    """A photo's camera, and its bodies: name, mesh labelled by its material, pose."""

    camera: Camera
    bodies: list[tuple[str, Mesh, Pose]]

    @property
    def poses(self) -> list[Pose]:
        """Of the bodies, in order."""
        return [pose for _, _, pose in self.bodies]

    @property
    def meshes(self) -> list[Mesh]:
        """The same."""
        return [mesh for _, mesh, _ in self.bodies]


def shot_of(seed: int, materials: list[int], number: int, names: list[str]) -> Shot:
    """The entries of one light, side by side: a body's middle stands in the middle of its own square."""
    width = SIDE * len(materials)
    camera, bodies = Camera(width, SIDE, CAMERA.focal, (width / 2, SIDE / 2)), []
    for k, m in enumerate(materials):
        caster = body(body_of(m, number))
        pose = pose_of(caster, np.random.default_rng([14, seed, m, number]))
        depth = (pose.rotation @ caster.centre + pose.translation)[2]
        aside = np.array([(SIDE * (k + 0.5) - width / 2) * depth / CAMERA.focal, 0.0, 0.0])
        label = np.full(len(caster.mesh.faces), names.index(SEVEN[m]) + 1, np.int16)
        bodies.append(
            (
                SEVEN[m],
                msgspec.structs.replace(caster.mesh, face_label=label),
                Pose(pose.rotation, pose.translation + aside),
            )
        )
    return Shot(camera, bodies)


def radiance_of(
    shot: Shot, seed: int, names: list[str], lit: Light, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """Radiance with noise, and the true normals; black beside the bodies."""
    maps, reflectances = rasterise(shot.meshes, shot.camera, shot.poses), materials_of(seed)
    picture = np.zeros(maps.normal.shape)
    for k, name in enumerate(names, start=1):
        shown = maps.label == k
        if shown.any():
            picture[shown] = spheres([reflectances[name]], lit, maps.normal[shown] @ YUP_FROM_CAMERA.T)[0]
    return picture * (1 + NOISE * rng.standard_normal(picture.shape)), maps.normal


def write_set(out: Path, seed: int, entries: list[Entry]) -> None:
    """Photos, masks, meshes, truth and dataset.yaml in the folder `out`."""
    names, photos, poses = [SEVEN[m] for m in sorted({m for m, _ in entries})], [], {}
    for folder in ("photos", "masks", "meshes", "truth"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for name in BODIES:
        write_exact_obj(out / f"meshes/{name}.obj", {"all": body(name).mesh})
    for number in sorted({li for _, li in entries}):
        photo, materials = f"photo{number}", [m for m, li in entries if li == number]
        map_, shot = light_map(seed, number, FULL.light_rows, FULL.light_spp), shot_of(seed, materials, number, names)
        picture, normals = radiance_of(shot, seed, names, light(map_), np.random.default_rng([15, seed, number]))
        write_photo(out / f"photos/{photo}.exr", picture)
        write_labels(out / f"masks/{photo}.png", labels_of(shot.meshes, shot.camera, shot.poses))
        write_light(out / f"truth/{photo}_light.exr", map_)
        write_normals(out / f"truth/{photo}_normal.exr", normals)
        photos.append(_photo_entry(photo, shot, [body_of(m, number) for m in materials]))
        poses[photo] = {name: pose for name, _, pose in shot.bodies}
    write_truth(out, {name: materials_of(seed)[name] for name in names}, poses)
    meshes = {name: {"file": f"meshes/{name}.obj", "material": names[0]} for name in BODIES}
    write_yaml(
        out / "dataset.yaml",
        {"format": 1, "materials": names, "meshes": meshes, "photos": photos, "truth": "truth/truth.yaml"},
        COMMENT,
    )


def _photo_entry(photo: str, shot: Shot, meshes: list[str]) -> dict:
    objects = [
        {"name": name, "mesh": mesh, "materials": {"all": name}, "pose": pose_entry(pose)}
        for (name, _, pose), mesh in zip(shot.bodies, meshes, strict=True)
    ]
    camera = {"focal_px": float(shot.camera.focal), "principal_point": [float(v) for v in shot.camera.centre]}
    return {
        "name": photo,
        "image": f"photos/{photo}.exr",
        "masks": f"masks/{photo}.png",
        "camera": camera,
        "objects": objects,
    }


def main(
    folder: Annotated[Path, typer.Argument(help="where the data set is written")],
    which: Annotated[str, typer.Option("--set", help="docksta, docksta-unlinked, lapd or photos")] = "docksta",
    seed: Annotated[int, typer.Option(help="of materials, lights and views")] = 0,
) -> None:
    """Write one set; its lights are those of the studies' worlds."""
    known = patterns(FULL)
    if which not in known:
        raise InputError(f"there is no set {which!r}", key="--set", cure=did_you_mean(which, known))
    write_set(folder, seed, known[which])
    print(f"{folder}: make all DATASET={folder}")


if __name__ == "__main__":
    typer.run(main)
