"""What the other stages wrote, read when it is asked for, one photo at a time; a file that is not there reads as None."""

import json
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.images.exr import read_exr, read_rgb_exr
from factorlib.reading import check_plain
from factorlib.results.materials import Channels as Factors
from factorlib.results.materials import MaterialTable, Solved, read_exposures, read_materials
from factorlib.results.metrics import Metrics, read_metrics
from factorlib.results.photos import PhotoFacts, read_photos
from factorlib.results.poses import PhotoPoses, read_poses
from factorlib.results.surface import SurfaceTable, read_surface

STAGES = ["masks", "align", "urm", "surface", "train", "solve", "export", "render", "evaluate"]

T = TypeVar("T")
Channels = dict[str, Float[np.ndarray, "h w"]]
Picture = Float[np.ndarray, "h w 3"]


class Artifacts(msgspec.Struct, frozen=True, dict=True):
    """folders: of the stages, by name;  set: `SetSlice` of the dataset's schema, in the order of dataset.yaml;  log: of the run"""

    folders: Mapping[str, Path]
    set: Any
    log: Path | None = None

    def read(self, reader: Callable[[Path], T], stage: str, name: str) -> T | None:
        """The file `name` of a stage's result, as `reader` reads it; InputError for what is no plain file."""
        path = self.folders[stage] / name
        if not path.exists():
            return None
        check_plain(path, "a result", most_bytes=None)
        return reader(path)

    def rgb(self, stage: str, name: str) -> Picture | None:
        """Linear radiance of <name>.exr."""
        return self.read(read_rgb_exr, stage, f"{name}.exr")

    def exr(self, stage: str, name: str) -> Channels | None:
        """All channels of <name>.exr."""
        return self.read(read_exr, stage, f"{name}.exr")

    def channels(self, stage: str, name: str) -> Channels:
        """Read the channels as `exr` does, of a file that is there."""
        channels = self.exr(stage, name)
        assert channels is not None
        return channels

    @cached_property
    def photo_facts(self) -> dict[str, PhotoFacts]:
        """Return what `masks` says of each photo."""
        return self.read(read_photos, "masks", "photos.json") or {}

    @cached_property
    def poses(self) -> dict[str, PhotoPoses]:
        """Return what `align` says of each photo."""
        return self.read(read_poses, "align", "poses.json") or {}

    @cached_property
    def surface(self) -> SurfaceTable:
        """Return what shading says of the meshes; as given, where there is no such result."""
        return read_surface(self.folders.get("surface"))

    @cached_property
    def solved(self) -> MaterialTable:
        """The materials, their gauge and model as solved; without materials where there is no solve."""
        return self.read(read_materials, "solve", "materials.json") or MaterialTable({})

    @cached_property
    def exported(self) -> dict[str, Solved]:
        """The materials in the gauge of the exported lights."""
        return (self.read(read_materials, "export", "materials.json") or MaterialTable({})).materials

    @cached_property
    def exposures(self) -> dict[str, Factors]:
        """Factors of photos on their lights."""
        return self.read(read_exposures, "solve", "exposures.json") or {}

    @cached_property
    def metrics(self) -> Metrics | None:
        """Return what `evaluate` measured."""
        return self.read(read_metrics, "evaluate", "metrics.json")

    def illumination_of(self, photo: str) -> str:
        """The light's name: the photo's own where nothing is known of the photo."""
        facts = self.photo_facts.get(photo)
        return facts.illumination if facts else photo

    def illuminations(self) -> dict[str, list[str]]:
        """Photos of each illumination, in the order of the set."""
        photos: dict[str, list[str]] = {}
        for photo in self.set.photos:
            photos.setdefault(self.illumination_of(photo), []).append(photo)
        return photos

    def events(self) -> list[dict]:
        """The run log, line by line."""
        lines = self.log.read_text(encoding="utf-8").splitlines() if self.log and self.log.exists() else []
        return [json.loads(line) for line in lines if line.strip()]
