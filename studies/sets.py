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

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError, did_you_mean
from factorlib.evaluate.ball import ball, light_of_lat_long
from factorlib.generate import folder as files
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from studies.catalogue.paper_sets import patterns
from studies.objects import BODIES, CAMERA, SIDE, body, body_of, pose_of
from studies.spheres import NOISE, light_map, materials_of
from studies.study import FULL, SEVEN, Entry

COMMENT = "Made in an observation pattern of the paper: python -m studies.sets"


def write_set(out: Path, seed: int, entries: list[Entry]) -> None:
    """Photos, masks, meshes, truth and dataset.yaml in the folder `out`."""
    names, photos, poses = [SEVEN[m] for m in sorted({m for m, _ in entries})], [], {}
    for folder in ("photos", "masks", "meshes", "truth"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for name in BODIES:
        files.write_exact_obj(out / f"meshes/{name}.obj", {"all": body(name).mesh})
    for number in sorted({li for _, li in entries}):
        photo, materials = f"photo{number}", [m for m, li in entries if li == number]
        poses[photo] = _write_photo(out, seed, number, materials, names)
        width = SIDE * len(materials)
        objects = [
            {
                "name": SEVEN[m],
                "mesh": body_of(m, number),
                "materials": {"all": SEVEN[m]},
                "pose": files.pose_entry(poses[photo][SEVEN[m]]),
            }
            for m in materials
        ]
        camera = {"focal_px": float(CAMERA.focal), "principal_point": [width / 2, SIDE / 2]}
        image, masks = f"photos/{photo}.exr", f"masks/{photo}.png"
        photos.append({"name": photo, "image": image, "masks": masks, "camera": camera, "objects": objects})
    truths = materials_of(seed, SEVEN)
    files.write_truth(out, {name: truths[name] for name in names}, poses)
    meshes = {name: {"file": f"meshes/{name}.obj", "material": names[0]} for name in BODIES}
    facts = {"format": 1, "materials": names, "meshes": meshes, "photos": photos, "truth": "truth/truth.yaml"}
    files.write_yaml(out / "dataset.yaml", facts, COMMENT)


def _write_photo(out: Path, seed: int, number: int, materials: list[int], names: list[str]) -> dict[str, Pose]:
    """The files of a photo, a body's middle in the middle of its own square; the poses by object."""
    width = SIDE * len(materials)
    camera, meshes, poses = Camera(width, SIDE, CAMERA.focal, (width / 2, SIDE / 2)), [], {}
    for k, m in enumerate(materials):
        caster = body(body_of(m, number))
        pose = pose_of(caster, np.random.default_rng([14, seed, m, number]))
        depth = (pose.rotation @ caster.centre + pose.translation)[2]
        aside = np.array([(SIDE * (k + 0.5) - width / 2) * depth / CAMERA.focal, 0.0, 0.0])
        label = np.full(len(caster.mesh.faces), names.index(SEVEN[m]) + 1, np.int16)
        meshes.append(msgspec.structs.replace(caster.mesh, face_label=label))
        poses[SEVEN[m]] = Pose(pose.rotation, pose.translation + aside)
    placed = list(poses.values())
    map_, maps = light_map(seed, number, FULL.light_rows, FULL.light_spp), rasterise(meshes, camera, placed)
    truths, lit, radiance = materials_of(seed, SEVEN), light_of_lat_long(map_), np.zeros(maps.normal.shape)
    for m in materials:
        inside = maps.label == names.index(SEVEN[m]) + 1
        radiance[inside] = ball(lit, truths[SEVEN[m]], maps.normal[inside] @ YUP_FROM_CAMERA.T)
    noise = np.random.default_rng([15, seed, number]).standard_normal(radiance.shape)
    files.write_photo(out / f"photos/photo{number}.exr", radiance * (1 + NOISE * noise))
    files.write_labels(out / f"masks/photo{number}.png", files.labels_of(meshes, camera, placed))
    files.write_light(out / f"truth/photo{number}_light.exr", map_)
    files.write_normals(out / f"truth/photo{number}_normal.exr", maps.normal)
    return poses


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
