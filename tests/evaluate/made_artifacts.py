"""Small but real artifacts of every stage before `evaluate`, made without them: balls in lights of a few lobes.

Each photo shows, side by side, one ball of each material it contains; the "estimate" is a perturbed truth.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.evaluate.ball import ball, light_of_lat_long
from factorlib.export.gltf import write_glb
from factorlib.generate.shapes import sphere
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import LAT_LONG, read_exr, write_exr, write_rgb_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.light.lobes import Lobes
from factorlib.results.lobes import write_lobes
from factorlib.results.materials import Reflectance
from factorlib.stage import Inputs
from factorlib.urm.extract import Taken, observations_of_photo
from factorlib.urm.observations import write_observations

SIZE = 24
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


def light_map(seed: int, height: int = 32) -> np.ndarray:
    """A lat-long map of a dim sky and three lobes."""
    rng = np.random.default_rng(seed)
    directions = lat_long_directions(height, 2 * height)
    value = np.full((*directions.shape[:2], 3), 0.15) * (1 + directions[..., 1:2])
    for sharpness in (8, 40, 150):
        axis = rng.normal(size=3) + [0, 0.7, 0.7]
        lobe = np.exp(sharpness * (directions @ (axis / np.linalg.norm(axis)) - 1))
        value = value + lobe[..., None] * rng.uniform(0.5, 1, 3) * sharpness / 6
    return value


def perturbed(material: Reflectance, error: float) -> Reflectance:
    return Reflectance(
        tuple(v * (1 + 0.04 * error) for v in material.diffuse),
        tuple(v * (1 - 0.05 * error) for v in material.specular),
        material.roughness + 0.02 * error,
    )


def make_artifacts(made: Made) -> Inputs:
    """Write every folder and return the inputs of `evaluate` and `report`."""
    materials = sorted({m for row in made.seen.values() for m in row})
    folders = {s: made.folder / s for s in ("masks", "align", "urm", "train", "solve", "export", "render", "truth")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    for k, (photo, seen) in enumerate(made.seen.items()):
        _photo(made, folders, photo, seen, materials, light_map(k))
    _whole(made, folders, materials)
    truth_files = {f"truth/{p}_env.exr": folders["truth"] / f"{p}_env.exr" for p in made.seen}
    truth_files |= {f"truth/{p}_normal.exr": folders["truth"] / f"{p}_normal.exr" for p in made.seen}
    facts = {
        "dataset.materials": materials,
        "dataset.objects": {
            p: {"camera": {}, "objects": [{"name": "balls", "mesh": "ball"}], "meshes": {}} for p in made.seen
        },
        "dataset.light": {p: {"illumination": p, "world_from_camera": None} for p in made.seen},
        "dataset.set": {"name": "made", "materials": materials, "photos": list(made.seen),
                        "meshes": {"ball": {"file": "ball.obj", "parts": None, "material": materials[0]}}},
        "dataset.truth": _truth(made, materials) if made.truth else None,
    }  # fmt: skip
    del folders["truth"]
    return Inputs(folders, facts, truth_files)


def _truth(made: Made, materials: list[str]) -> dict:
    return {
        "materials": {m: msgspec.to_builtins(TRUE[m]) for m in materials},
        "illumination": {p: f"truth/{p}_env.exr" for p in made.seen},
        "normals": {p: f"truth/{p}_normal.exr" for p in made.seen},
        "poses": {p: {"balls": {"rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 4.0]}} for p in made.seen},
    }


def _row_of_balls(names: list[str], make) -> np.ndarray:
    """Pictures of one value per ball, side by side, [SIZE, len(names) SIZE, c]."""
    normals, inside = ball_normals(SIZE)
    pictures = []
    for name in names:
        value = np.asarray(make(name, normals), float)
        picture = np.zeros((SIZE, SIZE, value.shape[-1]))
        picture[inside] = value
        pictures.append(picture)
    return np.concatenate(pictures, axis=1)


def _photo(
    made: Made, folders: dict, photo: str, seen: list[str], materials: list[str], light_values: np.ndarray
) -> None:
    light = light_of_lat_long(light_values)
    rgb = _row_of_balls(seen, lambda m, n: ball(light, TRUE[m], n))
    found = _row_of_balls(seen, lambda m, n: ball(light, perturbed(TRUE[m], made.error), n))
    label = _row_of_balls(seen, lambda m, n: np.full((len(n), 1), materials.index(m) + 1))[..., 0]
    normal = _row_of_balls(seen, lambda m, n: n @ YUP_FROM_CAMERA)
    _masks_and_align(folders, photo, np.minimum(rgb, made.clip), rgb >= made.clip, label, normal)
    observations = observations_of_photo(
        *(read_exr(folders[s] / f"{photo}.exr") for s in ("masks", "align")), Taken(photo, photo), materials
    )
    write_observations(folders["urm"] / f"{photo}.parquet", observations)
    counts = {m: int((label == materials.index(m) + 1).sum()) for m in seen}
    write_json(folders["masks"] / f"{photo}.json", {
        "width": label.shape[1], "height": SIZE, "factor": 1, "original_size": [label.shape[1], SIZE], "focal_px": None, "focal_source": None, "encoding": "srgb",
        "illumination": photo, "pixels": counts, "clipped_fraction": float((rgb >= made.clip).any(-1).mean()),
    })  # fmt: skip
    write_rgb_exr(folders["truth"] / f"{photo}_env.exr", light_values, LAT_LONG)
    write_exr(folders["truth"] / f"{photo}_normal.exr", {f"normal.{a}": normal[..., k] for k, a in enumerate("xyz")})
    _export_and_render(made, folders, photo, seen, light, light_values, found)


def _masks_and_align(folders, photo, rgb, clipped, label, normal) -> None:
    inside = (label > 0).astype(float)
    write_exr(folders["masks"] / f"{photo}.exr", {
        **{c: rgb[..., k] for k, c in enumerate("RGB")}, "label": label, "valid": inside,
        **{f"clipped.{c}": clipped[..., k] for k, c in enumerate("RGB")}, "object": inside, "left_out": 0 * inside,
    })  # fmt: skip
    write_exr(folders["align"] / f"{photo}.exr", {
        **{f"normal.{a}": normal[..., k] for k, a in enumerate("xyz")}, "view.x": 0 * inside, "view.y": 0 * inside,
        "view.z": -inside, "depth": 4 * inside, "label": label, "object": inside, "confidence": inside,
    })  # fmt: skip
    write_png(
        folders["align"] / f"{photo}_overlay.png", (np.stack([label / max(label.max(), 1)] * 3, -1) * 255).astype("u1")
    )


def _export_and_render(made: Made, folders, photo, seen, light, light_values, found) -> None:
    (folders["export"] / "illumination").mkdir(exist_ok=True)
    write_rgb_exr(folders["export"] / "illumination" / f"{photo}.exr", light_values * 1.1, LAT_LONG)
    for kind in ("resynthesis", f"materials/{photo}", f"reflectance_maps/{photo}"):
        (folders["render"] / kind).mkdir(parents=True, exist_ok=True)
    write_rgb_exr(folders["render"] / "resynthesis" / f"{photo}.exr", found)
    normals, inside = ball_normals(SIZE)
    for name in sorted({m for row in made.seen.values() for m in row}):
        picture = np.zeros((SIZE, SIZE, 3))
        picture[inside] = ball(light, perturbed(TRUE[name], made.error), normals)
        write_rgb_exr(folders["render"] / "materials" / photo / f"{name}.exr", picture)
        observed = inside & (name in seen) & (np.arange(SIZE) < 0.7 * SIZE)
        channels = {c: picture[..., k] for k, c in enumerate("RGB")}
        write_exr(folders["render"] / "reflectance_maps" / photo / f"{name}.exr", {**channels, "observed": observed})


def lobes_of(seed: int) -> Lobes:
    """A broad light and two lamps, in a camera's frame."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(3, 3)) - [0, 1, 1]
    return Lobes(
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        np.array([1.5, 60.0, 400.0]),
        rng.uniform(0.2, 1, (3, 3)) * [[0.5], [2], [8]],
    )


def _whole(made: Made, folders: dict, materials: list[str]) -> None:
    write_lobes(folders["export"] / "lobes.parquet", {photo: lobes_of(k) for k, photo in enumerate(made.seen)})
    shape = sphere(0.5)
    halves = msgspec.structs.replace(
        shape, face_label=1 + (np.arange(len(shape.faces)) % len(materials)).astype(np.int16)
    )
    write_glb(folders["export"] / "ball.glb", halves, materials, {m: perturbed(TRUE[m], made.error) for m in materials})
    photos = {p: msgspec.json.decode((folders["masks"] / f"{p}.json").read_bytes()) for p in made.seen}
    write_json(folders["masks"] / "photos.json", photos)
    pose = {"rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 4.0], "silhouette_iou": 0.98}
    camera = {"focal_px": 80.0, "principal_point": [SIZE / 2, SIZE / 2]}
    write_json(folders["align"] / "poses.json", {p: {"camera": camera, "objects": {"balls": pose}} for p in made.seen})
    entries = {m: msgspec.to_builtins(perturbed(TRUE[m], made.error)) for m in materials}
    for entry in entries.values():
        entry |= {
            "alpha": entry["roughness"] ** 2,
            "stderr": {"diffuse": [0.01] * 3, "specular": [0.005] * 3, "roughness": 0.01},
        }
    model = {"solver": "bundle", "lobes": dict.fromkeys(made.seen, 24)}
    result = {"materials": entries, "gauge": {"rule": "the lights are white on the whole"}, "model": model}
    for stage in ("solve", "export"):
        write_json(folders[stage] / "materials.json", result)
        write_json(folders[stage] / "exposures.json", {p: [1.0, 1.0, 1.0] for p in made.seen})
    steps = np.arange(30)
    history = {"iteration": steps, "round": steps // 10, "lobes": 4 * (1 + steps // 10)}
    history |= {"loss": np.exp(-steps / 5.0) + 0.01, "held_out": np.exp(-steps / 6.0) + 0.02}
    pq.write_table(pa.table({**history, "phase": ["joint"] * 30}), folders["solve"] / "convergence.parquet")
    bins = {
        "sharpness": {
            "3 to 30": {"median": 0.002, "p95": 0.02, "samples": 7},
            "30 to 300": {"median": 0.003},
            "0.3 to 3": {"median": 0.001},
        }
    }
    summary = {"median": 0.001, "p95": 0.004, "samples": 100}
    write_json(folders["train"] / "accuracy.json", {"diffuse": summary, "specular": summary | bins})
    curve = {
        "part": ["specular"] * 3 + ["diffuse"] * 3,
        "step": [100, 200, 300] * 2,
        "training_loss": [0.3, 0.2, 0.1] * 2,
    }
    curve |= {"held_out_median_error": [0.1, 0.05, 0.02] * 2, "held_out_p95_error": [0.3, 0.2, 0.1] * 2}
    pq.write_table(pa.table(curve), folders["train"] / "training.parquet")
