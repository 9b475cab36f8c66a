"""Small but real artifacts of every stage before `evaluate`, made without them: balls in lights of a few lobes.

Each photo shows, side by side, one ball of each material it contains; the "estimate" is a perturbed truth.
"""

from pathlib import Path

import msgspec
import numpy as np
import trimesh

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.evaluate.ball import ball, octahedral_light
from factorlib.export.gltf_writer import write_glb
from factorlib.generate.solids import sphere
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import LAT_LONG, read_exr, write_exr, write_rgb_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.light.lobes import Lobes
from factorlib.reflection.network import SHIPPED
from factorlib.results.lobe_table import write_lobes
from factorlib.results.materials import (
    Gauge,
    MaterialTable,
    Misfit,
    Model,
    Reflectance,
    StandardErrors,
    Uncertainty,
    attach_errors,
)
from factorlib.stage import Inputs
from factorlib.urm.extract import PhotoSource, extract_observations
from factorlib.urm.observations import write_observations

SIZE = 24
POSE = {"rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 4.0]}
TRUE = {
    "red": Reflectance((0.5, 0.1, 0.08), (0.06, 0.06, 0.06), 0.3),
    "white": Reflectance((0.6, 0.6, 0.55), (0.05, 0.05, 0.05), 0.5),
    "brass": Reflectance((0.05, 0.04, 0.02), (0.5, 0.4, 0.2), 0.25),
    "black": Reflectance((0.02, 0.02, 0.02), (0.04, 0.04, 0.04), 0.2),
}


class Made(msgspec.Struct):
    """What to make: `seen` is the materials in each photo; `error` scales the perturbation of the estimate."""

    folder: Path
    seen: dict[str, list[str]]
    error: float = 1.0
    truth: bool = True
    clip: float = 2.0
    held_out: tuple[str, ...] = ()


def light_map(seed: int) -> np.ndarray:
    """A lat-long map of a dim sky and three lobes."""
    rng = np.random.default_rng(seed)
    directions = lat_long_directions(32, 64)
    value = np.full((*directions.shape[:2], 3), 0.15) * (1 + directions[..., 1:2])
    for sharpness in (8, 40, 150):
        axis = rng.normal(size=3) + [0, 0.7, 0.7]
        lobe = np.exp(sharpness * (directions @ (axis / np.linalg.norm(axis)) - 1))
        value = value + lobe[..., None] * rng.uniform(0.5, 1, 3) * sharpness / 6
    return value


def scaled(material: Reflectance, diffuse, specular=None, rougher: float = 0.0) -> Reflectance:
    """Times a factor, or one for each part."""
    factors = diffuse, diffuse if specular is None else specular
    colours = (np.multiply(c, f).tolist() for c, f in zip((material.diffuse, material.specular), factors))
    return Reflectance(*map(tuple, colours), material.roughness + rougher)


def perturbed(material: Reflectance, error: float) -> Reflectance:
    return scaled(material, 1 + 0.04 * error, 1 - 0.05 * error, 0.02 * error)


def make_artifacts(made: Made) -> Inputs:
    """Write every folder and return the inputs of `evaluate` and `report`."""
    materials = sorted({m for row in made.seen.values() for m in row})
    stages = ("masks", "align", "urm", "train", "solve", "export/illumination", "render/resynthesis", "truth")
    for stage in stages:
        (made.folder / stage).mkdir(parents=True)
    folders = {stage: made.folder / stage for stage in (name.split("/")[0] for name in stages)}
    for k, photo in enumerate(made.seen):
        _photo(made, folders, photo, materials, light_map(k))
    _whole(made, folders, materials)
    truth = folders.pop("truth")
    meshes = {"ball": {"file": "ball.obj", "parts": None, "material": materials[0]}}
    balls = {"camera": {}, "objects": [{"name": "balls", "mesh": "ball"}], "meshes": meshes}
    trimesh.creation.icosphere(3, 0.5).export(made.folder / "ball.obj")
    facts = {
        "dataset.materials": materials,
        "dataset.objects": dict.fromkeys(made.seen, balls),
        "dataset.light": {
            p: {"illumination": p, "world_from_camera": None, "held_out": p in made.held_out} for p in made.seen
        },
        "dataset.set": {"name": "made", "materials": materials, "photos": list(made.seen), "meshes": meshes},
        "dataset.ground": {photo: {"ground": None} for photo in made.seen},
        "dataset.truth": {
            "materials": {m: msgspec.to_builtins(TRUE[m]) for m in materials},
            "illumination": {p: f"truth/{p}_env.exr" for p in made.seen},
            "normals": {p: f"truth/{p}_normal.exr" for p in made.seen},
            "poses": {p: {"balls": POSE} for p in made.seen},
            "albedo": {p: f"truth/{p}_albedo.exr" for p in made.seen},
        },
    }
    facts["dataset.truth"] = facts["dataset.truth"] if made.truth else None
    files = {"ball.obj": made.folder / "ball.obj"} | {f"truth/{file.name}": file for file in truth.iterdir()}
    return Inputs(folders, facts, files)


def paint(normals: np.ndarray) -> np.ndarray:
    """The factor on the diffuse reflectance of every ball, which no picture shows: it is for the true albedo alone."""
    return 1 + normals[:, :1] * [0.3, 0.2, 0.1]


def _balls(names: list[str], make) -> np.ndarray:
    """Pictures of one value per ball, side by side, [SIZE, len(names) SIZE, c]."""
    normals, inside = ball_normals(SIZE)
    values = [np.asarray(make(name, normals), float) for name in names]
    pictures = np.zeros((len(names), SIZE, SIZE, values[0].shape[-1]))
    for picture, value in zip(pictures, values, strict=True):
        picture[inside] = value
    return np.concatenate(list(pictures), axis=1)


def _photo(made: Made, folders: dict, photo: str, materials: list[str], light_values: np.ndarray) -> None:
    light, seen = octahedral_light(light_values), made.seen[photo]
    rgb = _balls(seen, lambda m, n: ball(light, TRUE[m], n))
    label = _balls(seen, lambda m, n: np.full((len(n), 1), materials.index(m) + 1))[..., 0]
    normal, inside = _balls(seen, lambda m, n: n @ YUP_FROM_CAMERA), (label > 0).astype(float)
    normals = {f"normal.{a}": normal[..., k] for k, a in enumerate("xyz")}
    masks = {c: np.minimum(rgb, made.clip)[..., k] for k, c in enumerate("RGB")} | {"label": label, "valid": inside}
    masks |= {f"clipped.{c}": (rgb >= made.clip)[..., k] for k, c in enumerate("RGB")}
    write_exr(folders["masks"] / f"{photo}.exr", {**masks, "object": inside, "left_out": 0 * inside})
    views = {"view.x": 0 * inside, "view.y": 0 * inside, "view.z": -inside}
    maps = {"depth": 4 * inside, "label": label, "object": inside, "confidence": inside}
    write_exr(folders["align"] / f"{photo}.exr", {**normals, **views, **maps})
    overlay = (np.stack([label / max(label.max(), 1)] * 3, -1) * 255).astype("u1")
    write_png(folders["align"] / f"{photo}_overlay.png", overlay)
    channels = [read_exr(folders[stage] / f"{photo}.exr") for stage in ("masks", "align")]
    write_observations(
        folders["urm"] / f"{photo}.parquet", extract_observations(*channels, PhotoSource(photo, photo), materials)
    )
    width, counts = label.shape[1], {m: int((label == materials.index(m) + 1).sum()) for m in seen}
    write_json(folders["masks"] / f"{photo}.json", {
        "width": width, "height": SIZE, "factor": 1, "original_size": [width, SIZE], "focal_px": None, "focal_source": None,
        "encoding": "srgb", "illumination": photo, "pixels": counts, "clipped_fraction": float((rgb >= made.clip).any(-1).mean()),
    })  # fmt: skip
    write_rgb_exr(folders["truth"] / f"{photo}_env.exr", light_values, LAT_LONG)
    write_exr(folders["truth"] / f"{photo}_normal.exr", normals)
    albedo = _balls(seen, lambda m, n: TRUE[m].diffuse * paint(n))
    write_rgb_exr(folders["truth"] / f"{photo}_albedo.exr", albedo)
    write_rgb_exr(folders["export"] / "illumination" / f"{photo}.exr", light_values * 1.1, LAT_LONG)
    again = _balls(seen, lambda m, n: ball(light, perturbed(TRUE[m], made.error), n))
    write_rgb_exr(folders["render"] / "resynthesis" / f"{photo}.exr", again)
    (folders["render"] / "materials" / photo).mkdir(parents=True)
    for name in materials:
        picture = _balls([name], lambda m, n: ball(light, perturbed(TRUE[m], made.error), n))
        write_rgb_exr(folders["render"] / "materials" / photo / f"{name}.exr", picture)


def lobes_of(seed: int) -> Lobes:
    """A broad light and two lamps, in a camera's frame."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(3, 3)) - [0, 1, 1]
    weight = rng.uniform(0.2, 1, (3, 3)) * [[0.5], [2], [8]]
    return Lobes(axis / np.linalg.norm(axis, axis=1, keepdims=True), np.array([1.5, 60.0, 400.0]), weight)


def _whole(made: Made, folders: dict, materials: list[str]) -> None:
    estimates = {m: perturbed(TRUE[m], made.error) for m in materials}
    write_lobes(folders["export"] / "lobes.parquet", {photo: lobes_of(k) for k, photo in enumerate(made.seen)})
    shape = sphere(0.5)
    labels = 1 + (np.arange(len(shape.faces)) % len(materials)).astype(np.int16)
    write_glb(folders["export"] / "ball.glb", msgspec.structs.replace(shape, face_label=labels), materials, estimates)
    write_json(folders["masks"] / "photos.json", {p: read_json(folders["masks"] / f"{p}.json") for p in made.seen})
    camera = {"focal_px": 80.0, "principal_point": [SIZE / 2, SIZE / 2]}
    entry = {"camera": camera, "objects": {"balls": {**POSE, "silhouette_iou": 0.98}}}
    write_json(folders["align"] / "poses.json", dict.fromkeys(made.seen, entry))
    errors = StandardErrors((0.01,) * 3, (0.005,) * 3, 0.01)
    model = Model(solver="joint", lobes=dict.fromkeys(made.seen, 24))
    gauge = Gauge("the lights are white on the whole")
    for stage in ("solve", "export"):
        table = MaterialTable({m: attach_errors(each, errors) for m, each in estimates.items()}, gauge, model)
        write_json(folders[stage] / "materials.json", table)
        write_json(folders[stage] / "exposures.json", {p: [1.0, 1.0, 1.0] for p in made.seen})
    misfits = {photo: Misfit(0.001, 0.01) for photo in made.seen}
    uncertainty = Uncertainty(1.0, dict.fromkeys(materials, errors), "by hand", 0.001, misfits)
    write_json(folders["solve"] / "uncertainty.json", uncertainty)
    bins = {"3 to 30": {"median": 0.002, "p95": 0.02, "samples": 7}, "30 to 300": {"median": 0.003}, "0.3 to 3": {"median": 0.001}}  # fmt: skip
    summary = {"median": 0.001, "p95": 0.004, "samples": 100}
    write_json(folders["train"] / "accuracy.json", {"diffuse": summary, "specular": {**summary, "sharpness": bins}})
    for part in ("diffuse", "specular"):
        (folders["train"] / f"{part}.safetensors").write_bytes((SHIPPED / f"{part}.safetensors").read_bytes())
