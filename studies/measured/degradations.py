"""Degraded sets of chairs and of solids, from good to hopeless, for `studies.measured.verdict`.

The photos, mesh, masks or links of each are degraded, by amounts that the set's number seeds.  The truth stays with the
set.
"""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from PIL import Image, ImageFilter

from factorlib.generate.chair import bend_parts, chair
from factorlib.generate.folder import write_labels, write_light, write_normals, write_obj, write_photo, write_yaml
from factorlib.images.exr import read_exr, read_rgb_exr
from factorlib.images.tone import srgb_decode, srgb_encode
from factorlib.meshes.mesh import smooth
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.meshes.read_mesh import read_mesh

Rng = np.random.Generator
Spec = dict[str, Any]  # the content of dataset.yaml
MESH = "meshes/chair.obj"
TRUTH = "truth/truth.yaml"


def keep(spec: Spec, names: list[str]) -> None:
    """Remove all other photos from the set."""
    spec["photos"] = [photo for photo in spec["photos"] if photo["name"] in names]


def exact(folder: Path, spec: Spec, rng: Rng) -> None:
    """Give the true mesh and its poses."""
    solid = {name: smooth(*part) for name, part in chair().items()}
    write_obj(folder / MESH, {name: (mesh.vertices, mesh.faces, mesh.normals) for name, mesh in solid.items()})
    poses = yaml.safe_load((folder / TRUTH).read_text())["poses"]
    for photo in spec["photos"]:
        for obj in photo["objects"]:
            obj["pose"] = poses[photo["name"]][obj["name"]]


def bend_chair(folder: Path, spec: Spec, rng: Rng, triangles: int, warp: float, stretched: bool = False) -> None:
    """Give a mesh of so many triangles a part, bent by a share of its extent; stretched, it is another chair."""
    axes = np.exp(rng.normal(0, 0.25, 3)) if stretched else 1.0
    parts = bend_parts(chair(), rng, triangles, warp)
    write_obj(folder / MESH, {name: (vertices * axes, faces) for name, (vertices, faces) in parts.items()})


def bend_solids(folder: Path, spec: Spec, rng: Rng, triangles: int, warp: float) -> None:
    """Give meshes of so many triangles, each bent by a share of its extent."""
    for file in sorted((folder / "meshes").glob("*.ply")):
        mesh = read_mesh(file, ["all"], "all")
        vertices, faces = bend_parts({"all": (mesh.vertices, mesh.faces)}, rng, triangles, warp)["all"]
        write_ply(file, smooth(vertices, faces))


def few(folder: Path, spec: Spec, rng: Rng) -> None:
    """Keep two to four photos, but not all, and remove the others."""
    names = [photo["name"] for photo in spec["photos"]]
    keep(spec, list(rng.permutation(names)[: rng.integers(2, min(5, len(names)))]))


def one_photo(folder: Path, spec: Spec, rng: Rng) -> None:
    """Keep one photo of one chair, and remove the others."""
    keep(spec, [str(rng.choice([photo["name"] for photo in spec["photos"] if len(photo["objects"]) == 1]))])


def unlinked(folder: Path, spec: Spec, rng: Rng) -> None:
    """Keep two photos of one chair each, of different colours, whose wood has two names: nothing links them."""
    names = [("garden", "office"), ("office", "patio"), ("kitchen", "garden"), ("kitchen", "office")][rng.integers(4)]
    keep(spec, list(names))
    spec["materials"].append("wood_2")
    photo = spec["photos"][1]
    photo["objects"][0]["materials"]["legs"] = "wood_2"
    relabel(folder, photo, {spec["materials"].index("wood") + 1: len(spec["materials"])})


def miscalled(folder: Path, spec: Spec, rng: Rng) -> None:
    """Give the shells of two photos, of one chair each, the other's material."""
    single = [photo for photo in spec["photos"] if len(photo["objects"]) == 1]
    if len(single) < 2:
        return
    pair = [single[k] for k in rng.permutation(len(single))[:2]]
    shells = [photo["objects"][0]["materials"]["shell"] for photo in pair]
    for photo, old, new in zip(pair, shells, shells[::-1], strict=True):
        photo["objects"][0]["materials"]["shell"] = new
        relabel(folder, photo, {spec["materials"].index(old) + 1: spec["materials"].index(new) + 1})


def clipped(folder: Path, spec: Spec, rng: Rng) -> None:
    """Expose all photos two to three stops more."""
    expose(folder, spec, 2 ** rng.uniform(2, 3))


def dark(folder: Path, spec: Spec, rng: Rng) -> None:
    """Expose all photos four to six stops less: few codes are left."""
    expose(folder, spec, 2 ** -rng.uniform(4, 6))


def noisy(folder: Path, spec: Spec, rng: Rng) -> None:
    """Add noise of 5 to 15 % of white."""
    sigma = rng.uniform(0.05, 0.15)
    each_photo(folder, spec, lambda linear: linear + rng.normal(0, sigma, linear.shape))


def developed(folder: Path, spec: Spec, rng: Rng) -> None:
    """Give every photo another contrast and tint, and sharpen it: what phones and programs do."""

    def change(linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        """Change one photo."""
        return np.maximum(linear, 0) ** rng.uniform(0.5, 1.8) * np.exp(rng.normal(0, 0.2, 3))

    each_photo(folder, spec, change, ImageFilter.UnsharpMask(8, 150))


def tiny(folder: Path, spec: Spec, rng: Rng) -> None:
    """Make all pictures six times smaller."""
    for photo in spec["photos"]:
        image = folder / photo["image"]
        masks = [photo["masks"], *(obj["mask"] for obj in photo["objects"] if "mask" in obj)]
        small, focal = shrink(image, Image.Resampling.BOX)
        write_photo(image, srgb_decode(small / 255.0), focal)
        for file in masks:
            write_labels(folder / file, shrink(folder / file, Image.Resampling.NEAREST)[0])
        file = folder / f"truth/{photo['name']}_normal.exr"
        channels = read_exr(file)
        write_normals(file, np.stack([channels[f"normal.{axis}"][3::6, 3::6] for axis in "xyz"], axis=-1))
        if "camera" in photo:
            photo["camera"] = {"focal_px": photo["camera"]["focal_px"] / 6}


def shrink(file: Path, resampling: Image.Resampling) -> tuple[np.ndarray, int | None]:
    """Return a picture six times smaller, and its focal length."""
    with Image.open(file) as picture:
        return np.asarray(picture.resize((picture.width // 6, picture.height // 6), resampling)), focal_of(picture)


KINDS: dict[str, Callable[[Path, Spec, Rng], None]] = {
    "exact": exact,
    "bent": partial(bend_solids, triangles=500, warp=0.02),
    "bent_further": partial(bend_solids, triangles=200, warp=0.05),
    "rough": partial(bend_chair, triangles=500, warp=0.02),
    "rougher": partial(bend_chair, triangles=200, warp=0.05),
    "another_chair": partial(bend_chair, triangles=80, warp=0.1, stretched=True),
    "few": few,
    "one_photo": one_photo,
    "unlinked": unlinked,
    "miscalled": miscalled,
    "clipped": clipped,
    "dark": dark,
    "noisy": noisy,
    "developed": developed,
    "tiny": tiny,
}
# Degradations of a set of chairs, one after the other, and of one of solids; each entry is used equally often.
MIXED = (
    [], [], ["exact"], ["exact"], ["few"], ["exact", "few"], ["rough"], ["rough", "few"], ["rougher"],
    ["another_chair"], ["one_photo"], ["one_photo", "exact"], ["unlinked"], ["miscalled"], ["clipped"],
    ["exact", "dark"], ["noisy"], ["developed"], ["tiny"], ["few", "tiny", "rougher"],
)  # fmt: skip
MIXED_SOLIDS = ([], ["bent"], ["bent_further"], ["bent", "few"])


def degrade(base: Path, folder: Path, kinds: list[str], seed: int) -> None:
    """Write the set in `base`, degraded, to a new folder, which exists only once it is complete."""
    draft = folder.with_name(f"{folder.name}.new")
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(base, draft)
    spec = yaml.safe_load((draft / "dataset.yaml").read_text())
    rng = np.random.default_rng([17, seed])
    for kind in kinds:
        KINDS[kind](draft, spec, rng)
    write_yaml(draft / "dataset.yaml", spec, f"degraded: {', '.join(kinds) or 'nothing'}")
    truth = truth_of(spec, yaml.safe_load((draft / TRUTH).read_text()))
    write_yaml(draft / TRUTH, truth, "truth of the photos and materials that are left")
    draft.rename(folder)


def truth_of(spec: Spec, truth: Spec) -> Spec:
    """Return the truth of the remaining photos and their materials, because others are not to be scored."""
    names = [photo["name"] for photo in spec["photos"]]
    objects = [obj for photo in spec["photos"] for obj in photo["objects"]]
    visible = {name for obj in objects for name in materials_of(obj, spec["meshes"][obj["mesh"]])}
    materials = {name: truth["materials"][name.removesuffix("_2")] for name in spec["materials"] if name in visible}
    by_photo = {key: {name: truth[key][name] for name in names} for key in ("illumination", "normals", "poses")}
    return {"materials": materials, **by_photo}


def materials_of(obj: Spec, mesh: Spec) -> set[str]:
    """Return the materials of an object with that mesh."""
    parts = mesh.get("parts", {"all": mesh.get("material")})
    return {*(parts | obj.get("materials", {})).values()}


def relabel(folder: Path, photo: Spec, new: dict[int, int]) -> None:
    """Change labels in the photo's mask."""
    with Image.open(folder / photo["masks"]) as picture:
        labels = np.asarray(picture)
    table = np.arange(256, dtype=np.uint8)
    table[list(new)] = list(new.values())
    write_labels(folder / photo["masks"], table[labels])


def expose(folder: Path, spec: Spec, factor: float) -> None:
    """Multiply the exposure of all photos by a factor, and their true lights, which are in the photos' units."""
    each_photo(folder, spec, lambda linear: linear * factor)
    for photo in spec["photos"]:
        file = folder / f"truth/{photo['name']}_light.exr"
        write_light(file, read_rgb_exr(file) * factor)


def focal_of(picture: Image.Image) -> int | None:
    """Return the focal length that the picture's EXIF gives, of 35 mm film; None if it gives none."""
    return picture.getexif().get_ifd(0x8769).get(0xA405)


def each_photo(folder: Path, spec: Spec, change: Callable, filtered: ImageFilter.Filter | None = None) -> None:
    """Change the linear radiance of every photo, then its picture."""
    for photo in spec["photos"]:
        with Image.open(folder / photo["image"]) as picture:
            focal = focal_of(picture)
            linear = np.clip(change(srgb_decode(np.asarray(picture) / 255.0)), 0, 1)
        if filtered:
            sharpened = Image.fromarray((srgb_encode(linear) * 255 + 0.5).astype(np.uint8)).filter(filtered)
            linear = srgb_decode(np.asarray(sharpened) / 255.0)
        write_photo(folder / photo["image"], linear, focal)
