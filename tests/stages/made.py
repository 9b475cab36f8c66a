"""What `masks` and a data set hand to the stages after them, of photos of one chair, for tests."""

from pathlib import Path

import numpy as np

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Maps
from factorlib.images.exr import write_exr
from factorlib.jsonfile import write_json
from factorlib.results.lobe_table import write_lobes


class Killed(Exception):
    """The end of a stage in its midst."""


class Rising:
    """A stage's progress, which must never fall; `moves`: how often it rose."""

    def __init__(self):
        self.share, self.moves = 0.0, 0

    def __call__(self, done: float, total: float, text: str = "") -> None:
        assert self.share - 1e-9 <= done / total <= 1, text
        self.moves, self.share = self.moves + (done / total > self.share), done / total


def ran(stage, inputs, out: Path, progress=None, **params) -> Path:
    """Run a stage with these parameters into a folder that is made where it is not there, and return it."""
    out.mkdir(parents=True, exist_ok=True)
    stage.main(stage.Params(**params), inputs, out, progress or Rising())
    return out


def write_masks(folder: Path, photo: str, label: np.ndarray, focal, source, channels=None) -> None:
    """The result of `masks` for a photo that is as bright as its label, or has these channels."""
    zero, (height, width) = np.zeros(label.shape), label.shape
    channels = channels or {**dict.fromkeys("RGB", label), "label": label}
    write_exr(folder / f"{photo}.exr", {**channels, "left_out": zero, "object": zero})
    facts = {"width": width, "height": height, "factor": 1, "original_size": [width, height]}
    write_json(folder / f"{photo}.json", {**facts, "focal_px": focal, "focal_source": source})


def entry_of(pose: Pose, **more) -> dict:
    """A pose as dataset.yaml and poses.json have it."""
    return {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist(), **more}


def write_aligned(folder: Path, photo: str, maps: Maps, **channels) -> None:
    """The maps of `align` for a photo in which every pixel of an object is sure, with further channels."""
    axes = {f"{kind}.{a}": getattr(maps, kind)[..., k] for kind in ("normal", "view") for k, a in enumerate("xyz")}
    plain = {"label": maps.label, "depth": maps.depth, "object": maps.object, "confidence": maps.label > 0}
    write_exr(folder / f"{photo}.exr", {**axes, **plain, **channels})


def poses_of(camera: Camera, **poses: Pose) -> dict:
    """The entry of a photo in poses.json."""
    lens = {"focal_px": camera.focal, "principal_point": list(camera.centre)}
    return {"camera": lens, "objects": {name: entry_of(pose, silhouette_iou=1.0) for name, pose in poses.items()}}


def write_solution(folder: Path, materials: dict, lights: dict, exposures: dict) -> None:
    """What `solve` leaves for the stages after it, of materials by their diffuse, specular and roughness."""
    stderr = {"diffuse": [0.1] * 3, "specular": [0.1] * 3, "roughness": 0.1}
    table = {n: {**m, "alpha": m["roughness"] ** 2, "stderr": stderr} for n, m in materials.items()}
    write_json(folder / "materials.json", {"materials": table, "gauge": {"rule": "by hand"}, "model": {}})
    write_json(folder / "exposures.json", exposures)
    write_lobes(folder / "lobes.parquet", lights)


def chair_facts(material: str = "white", **more) -> dict:
    """The slice `objects` of a photo of a chair in chair.ply."""
    meshes = {"chair": {"file": "chair.ply", "material": material}}
    return {"camera": {}, "objects": [{"name": "chair", "mesh": "chair", **more}], "meshes": meshes}
