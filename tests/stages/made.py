"""What `masks` and a data set hand to the stages after them, of photos of one chair, for tests."""

from pathlib import Path

import numpy as np

from factorlib.geometry.camera import Pose
from factorlib.images.exr import write_exr
from factorlib.jsonfile import write_json


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


def chair_facts(material: str = "white", **more) -> dict:
    """The slice `objects` of a photo of a chair in chair.ply."""
    meshes = {"chair": {"file": "chair.ply", "material": material}}
    return {"camera": {}, "objects": [{"name": "chair", "mesh": "chair", **more}], "meshes": meshes}
