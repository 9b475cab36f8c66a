"""What the other stages wrote, read when it is asked for, one photo at a time; a file that is not there reads as None."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import msgspec
import numpy as np
import pyarrow.parquet as pq
from jaxtyping import Float

from factorlib.images.exr import read_exr, read_rgb_exr
from factorlib.images.picture import read_png
from factorlib.jsonfile import read_json
from factorlib.light.lobes import Lobes
from factorlib.results.exposures import read_exposures
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import Channels as Factors
from factorlib.results.materials import MaterialTable, Solved, read_materials
from factorlib.results.metrics import Metrics, read_metrics
from factorlib.results.photos import PhotoFacts, read_photos
from factorlib.results.poses import PhotoPoses, read_poses
from factorlib.urm.observations import Observations, read_observations

T = TypeVar("T")
Channels = dict[str, Float[np.ndarray, "h w"]]
Picture = Float[np.ndarray, "h w 3"]


@runtime_checkable
class PhotoSet(Protocol):
    """The set as a whole (`SetSlice` of the dataset's schema), in the order of dataset.yaml."""

    name: str
    materials: list[str]
    photos: list[str]


class Artifacts(msgspec.Struct, frozen=True):
    """The folders of the stages by name, the set, and the run log."""

    folders: Mapping[str, Path]
    set: PhotoSet
    log: Path | None = None

    def accuracy(self) -> dict[str, Any] | None:
        """Of the networks, as `train` measured it."""
        return self._read(read_json, "train", "accuracy.json")

    def photo_facts(self) -> dict[str, PhotoFacts]:
        """By photo."""
        return self._read(read_photos, "masks", "photos.json") or {}

    def poses(self) -> dict[str, PhotoPoses]:
        """By photo."""
        return self._read(read_poses, "align", "poses.json") or {}

    def solved(self) -> MaterialTable:
        """The materials, their gauge and model as solved; without materials where there is no solve."""
        return self._read(read_materials, "solve", "materials.json") or MaterialTable({})

    def exported(self) -> dict[str, Solved]:
        """The materials in the gauge of the exported lights."""
        found = self._read(read_materials, "export", "materials.json")
        return found.materials if found else {}

    def lobes(self) -> dict[str, Lobes]:
        """The exported lights, by illumination, each in its own frame."""
        return self._read(read_lobes, "export", "lobes.parquet") or {}

    def exposures(self) -> dict[str, Factors]:
        """Factors of photos on their lights."""
        return self._read(read_exposures, "solve", "exposures.json") or {}

    def metrics(self) -> Metrics | None:
        """What `evaluate` found."""
        return self._read(read_metrics, "evaluate", "metrics.json")

    def illumination_of(self, photo: str) -> str:
        """The light's name: the photo's own where nothing is known of the photo."""
        facts = self.photo_facts().get(photo)
        return facts.illumination if facts else photo

    def illuminations(self) -> dict[str, list[str]]:
        """Photos of each illumination, in the order of the set."""
        found: dict[str, list[str]] = {}
        for photo in self.set.photos:
            found.setdefault(self.illumination_of(photo), []).append(photo)
        return found

    def masks(self, photo: str) -> Channels:
        """Linear radiance R, G, B, `label`, `valid` and `clipped.*` of a photo."""
        return read_exr(self.folders["masks"] / f"{photo}.exr")

    def geometry(self, photo: str) -> Channels:
        """Normals, view directions, depth and labels of a photo, as `align` writes them."""
        return read_exr(self.folders["align"] / f"{photo}.exr")

    def overlay(self, photo: str) -> np.ndarray | None:
        """The mesh drawn over the photo, sRGB."""
        path = self.folders["align"] / f"{photo}_overlay.png"
        return read_png(path) if path.exists() else None

    def observations(self, photo: str) -> Observations | None:
        """The photo's observations."""
        path = self.folders["urm"] / f"{photo}.parquet"
        return read_observations(path) if path.exists() else None

    def resynthesis(self, photo: str) -> Picture | None:
        """The photo rendered again, linear radiance."""
        return self._rgb(self.folders["render"] / "resynthesis" / f"{photo}.exr")

    def ball(self, photo: str, material: str) -> Picture | None:
        """A ball of a material in the photo's light, linear radiance."""
        return self._rgb(self.folders["render"] / "materials" / photo / f"{material}.exr")

    def reflectance_map(self, photo: str, material: str) -> Channels | None:
        """Radiance of a material by normal in the photo's light, with the channel `observed`."""
        path = self.folders["render"] / "reflectance_maps" / photo / f"{material}.exr"
        return read_exr(path) if path.exists() else None

    def illumination(self, name: str) -> Picture | None:
        """The solved map of a light, linear radiance."""
        return self._rgb(self.folders["export"] / "illumination" / f"{name}.exr")

    def coverage(self, name: str) -> Picture | None:
        """The standard error of a light's map over its mean radiance."""
        return self._rgb(self.folders["export"] / "coverage" / f"{name}.exr")

    def true_illumination(self, name: str) -> Picture | None:
        """The true map of a light, linear radiance."""
        return self._rgb(self.folders["evaluate"] / "illumination" / f"{name}.exr")

    def spheres(self, name: str, which: str) -> Picture | None:
        """Mirror, glossy and Lambertian sphere side by side; `which` is estimate or truth."""
        return self._rgb(self.folders["evaluate"] / "spheres" / f"{name}_{which}.exr")

    def convergence(self) -> dict[str, list]:
        """The history of the solve, as columns."""
        return self._table(self.folders["solve"] / "convergence.parquet")

    def training(self) -> dict[str, list]:
        """The curve of the networks' training, as columns."""
        return self._table(self.folders["train"] / "training.parquet")

    def events(self) -> list[dict]:
        """The run log, line by line."""
        if self.log is None or not self.log.exists():
            return []
        return [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines() if line.strip()]

    def _read(self, reader: Callable[[Path], T], stage: str, name: str) -> T | None:
        path = self.folders[stage] / name
        return reader(path) if path.exists() else None

    @staticmethod
    def _rgb(path: Path) -> Picture | None:
        return read_rgb_exr(path) if path.exists() else None

    @staticmethod
    def _table(path: Path) -> dict[str, list]:
        return pq.read_table(path).to_pydict() if path.exists() else {}
