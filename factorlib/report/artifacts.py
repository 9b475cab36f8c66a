"""Results of the other stages, read on demand, one photo at a time; a missing file reads as None."""

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
from factorlib.results.exchange import Exchange, read_exchange
from factorlib.results.materials import Channels as Factors
from factorlib.results.materials import MaterialTable, read_exposures, read_materials
from factorlib.results.metrics import Metrics, read_metrics
from factorlib.results.photos import PhotoFacts, read_photos
from factorlib.results.poses import PhotoPoses, read_poses
from factorlib.results.surface_table import SurfaceTable, read_surface
from factorlib.results.texture_table import TextureTable, read_table

STAGES = [
    "masks",
    "shapes",
    "align",
    "urm",
    "train",
    "surface",
    "solve",
    "shading",
    "texture",
    "exchange",
    "export",
    "render",
    "evaluate",
]

T = TypeVar("T")
Channels = dict[str, Float[np.ndarray, "h w"]]
Picture = Float[np.ndarray, "h w 3"]


class Artifacts(msgspec.Struct, frozen=True, dict=True):
    """Results of one run.

    Attributes:
        folders: folders of the stages, by name
        set: `SetSlice` of the dataset's schema, in the order of dataset.yaml
        log: the run log
    """

    folders: Mapping[str, Path]
    set: Any
    log: Path | None = None

    def read(self, reader: Callable[[Path], T], stage: str, name: str) -> T | None:
        """Read a file of a stage's result.

        Args:
            reader: reads the file
            stage: name of the stage
            name: name of the file

        Returns:
            The file's content, or None if it does not exist.

        Raises:
            InputError: The path is not a plain file.
        """
        path = self.folders[stage] / name
        if not path.exists():
            return None
        check_plain(path, "a result", most_bytes=None)
        return reader(path)

    def rgb(self, stage: str, name: str) -> Picture | None:
        """Return the linear radiance of <name>.exr in a stage's result; None if it does not exist."""
        return self.read(read_rgb_exr, stage, f"{name}.exr")

    def channels(self, stage: str, name: str) -> Channels:
        """Return all channels of <name>.exr in a stage's result, which must exist."""
        channels = self.read(read_exr, stage, f"{name}.exr")
        assert channels is not None
        return channels

    @cached_property
    def photo_facts(self) -> dict[str, PhotoFacts]:
        """Facts about each photo from `masks`."""
        return self.read(read_photos, "masks", "photos.json") or {}

    @cached_property
    def poses(self) -> dict[str, PhotoPoses]:
        """Camera and object poses of each photo from `align`."""
        return self.read(read_poses, "align", "poses.json") or {}

    @cached_property
    def surface(self) -> SurfaceTable:
        """Refinements of the meshes from `surface`; none if there is no such result."""
        return read_surface(self.folders.get("surface"))

    @cached_property
    def texture(self) -> TextureTable:
        """Albedo textures from `texture`; none if there is no such result."""
        return read_table(self.folders.get("texture"))

    @cached_property
    def exchange(self) -> Exchange:
        """Decision on the exchange of paint and light."""
        return read_exchange(self.folders.get("exchange"))

    @cached_property
    def solved(self) -> MaterialTable:
        """Gauge and model of the solve, and materials in its gauge; without materials if there is no solve."""
        return self.read(read_materials, "solve", "materials.json") or MaterialTable({})

    @cached_property
    def exported(self) -> MaterialTable:
        """The table of materials.json, in the gauge of the exported lights; without materials if there is no export."""
        return self.read(read_materials, "export", "materials.json") or MaterialTable({})

    @cached_property
    def exposures(self) -> dict[str, Factors]:
        """Factors of photos on their lights, by photo and per channel."""
        return self.read(read_exposures, "solve", "exposures.json") or {}

    @cached_property
    def metrics(self) -> Metrics | None:
        """Errors of the result from `evaluate`; None if that has not run."""
        return self.read(read_metrics, "evaluate", "metrics.json")

    def illumination_of(self, photo: str) -> str:
        """Return the name of a photo's light, or the photo's own name if the photo is unknown."""
        facts = self.photo_facts.get(photo)
        return facts.illumination if facts else photo

    def illuminations(self) -> dict[str, list[str]]:
        """Return the photos of each light, in the order of the set."""
        photos: dict[str, list[str]] = {}
        for photo in self.set.photos:
            photos.setdefault(self.illumination_of(photo), []).append(photo)
        return photos

    def events(self) -> list[dict]:
        """Return the events of the run log, in order."""
        lines = self.log.read_text(encoding="utf-8").splitlines() if self.log and self.log.exists() else []
        return [json.loads(line) for line in lines if line.strip()]
