"""Light as a sum of spherical Gaussian lobes w · exp(λ(ω·z − 1)), and lobes.parquet.

A lobe's exponent is never computed as λ(ω·z − 1), which has no digits left at λ = 10⁶ in single precision, but as
−λ|ω − z|²/2 or from half angles.  Its integral is 2π(−expm1(−2λ))/λ, a series where λ is small.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float

from factorlib.parquetfile import read_columns
from factorlib.reading import reading
from factorlib.wholefile import writing

FRAME = (
    "camera frame of the illumination's photo (OpenCV: x right, y down, z forward), or the world where its photos give world_from_camera"
)
COLUMNS = ("axis_x", "axis_y", "axis_z", "sharpness", "weight_r", "weight_g", "weight_b")
SMALL_SHARPNESS = 1e-3
WHAT, CURE = "a table of lobes", "run the stage `solve` again"


class Lobes(msgspec.Struct, frozen=True):
    """p lobes w · exp(λ(ω·z − 1)), float64.

    axis:      z, unit, in the illumination's frame
    sharpness: λ ≥ 0
    weight:    w ≥ 0, radiance at the axis per channel, linear Rec. 709
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: Float[np.ndarray, " p"]
    weight: Float[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.sharpness)

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> Lobes:
        """The same light in another frame: `rotation` = new_from_old."""
        return Lobes(self.axis @ np.asarray(rotation).T, self.sharpness, self.weight)

    def scaled(self, factor: float | Float[np.ndarray, "3"]) -> Lobes:
        """The light times `factor`, a number or one per channel."""
        return Lobes(self.axis, self.sharpness, self.weight * np.asarray(factor))

    def radiance(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Sum of the lobes in unit `directions`."""
        return np.exp(-0.5 * self.sharpness * squared_distances(directions, self.axis)) @ self.weight

    @property
    def energy(self) -> Float[np.ndarray, "3"]:
        """∫ of the light over the sphere, radiance × steradian."""
        return lobe_integral(self.sharpness) @ self.weight


def squared_distances(directions: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "n p"]:
    """|ω − z|², by differences: it keeps its digits where it is small."""
    return sum((directions[:, None, k] - axes[None, :, k]) ** 2 for k in range(3))


def lobe_integral(sharpness: float | Float[np.ndarray, "*p"]) -> float | Float[np.ndarray, "*p"]:
    """∫ exp(λ(ω·z − 1)) dω over the sphere, steradian.

    >>> (lobe_integral(np.array([0.0, 1e-12, 1e6])) / np.pi).round(9).tolist()
    [4.0, 4.0, 2e-06]
    """
    sharpness = np.asarray(sharpness, dtype=float)
    small = sharpness < SMALL_SHARPNESS
    safe = np.where(small, 1.0, sharpness)
    series = 2 - 2 * sharpness + 4 / 3 * sharpness**2
    return 2 * np.pi * np.where(small, series, -np.expm1(-2 * safe) / safe)


def no_lobes() -> Lobes:
    """Darkness."""
    return Lobes(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))


def write_lobes(path: str | Path, lights: Mapping[str, Lobes]) -> None:
    """Write lobes.parquet: one row per lobe, illuminations by name; an illumination may have no lobe."""
    names = sorted(lights)
    rows = [np.column_stack([lights[n].axis, lights[n].sharpness, lights[n].weight]) for n in names]
    table = np.concatenate([np.zeros((0, len(COLUMNS))), *rows]).astype(float)
    illumination = [name for name, part in zip(names, rows, strict=True) for _ in range(len(part))]
    columns = {"illumination": pa.array(illumination, pa.string())} | {c: pa.array(table[:, k]) for k, c in enumerate(COLUMNS)}
    about = {"frame": FRAME, "lobe": "weight * exp(sharpness * (dot(direction, axis) - 1))", "illuminations": names}
    metadata = {"factorlib": json.dumps(about, sort_keys=True, ensure_ascii=False)}
    with writing(path):
        pq.write_table(pa.table(columns, metadata=metadata), path, compression="zstd")


def read_lobes(path: str | Path) -> dict[str, Lobes]:
    """Lobes by illumination; raises InputError for a file that `write_lobes` did not write."""
    columns, about = read_columns(path, WHAT, ("illumination", *COLUMNS), cure=CURE)
    with reading(WHAT, path, cure=CURE):
        names = msgspec.convert(about["illuminations"], list[str])
        values = np.column_stack([columns[c].cast(pa.float64()).to_numpy(zero_copy_only=False) for c in COLUMNS]).reshape(-1, len(COLUMNS))
        illumination = np.array(columns["illumination"].to_pylist(), dtype=object)
        if not set(illumination) <= set(names):
            raise ValueError("a lobe of an illumination that its metadata do not name")
    parts = {name: values[illumination == name] for name in names}
    return {name: Lobes(part[:, :3].copy(), part[:, 3].copy(), part[:, 4:].copy()) for name, part in parts.items()}
