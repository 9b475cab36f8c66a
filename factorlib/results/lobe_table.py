"""lobes.parquet of `solve` and `export`: the light of each illumination, one row per lobe."""

import json
import logging
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factorlib.dataset.schema import LightSlice
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.parquetfile import read_columns
from factorlib.reading import reading
from factorlib.results.materials import read_exposures
from factorlib.wholefile import writing

FRAME = (
    "camera frame of the illumination's photo (OpenCV: x right, y down, z forward), "
    "or the world where its photos give world_from_camera"
)
COLUMNS = ("axis_x", "axis_y", "axis_z", "sharpness", "weight_r", "weight_g", "weight_b")
WHAT = "a table of lobes"
CURE = "run the stage `solve` again"
log = logging.getLogger("factorlib.results")


def write_lobes(path: str | Path, lights: Mapping[str, Lobes]) -> None:
    """Write lobes.parquet, sorted by illumination; an illumination may have no lobe."""
    names = sorted(lights)
    rows = [np.column_stack([lights[n].axis, lights[n].sharpness, lights[n].weight]) for n in names]
    table = np.concatenate([np.zeros((0, len(COLUMNS))), *rows]).astype(float)
    illumination = [name for name, part in zip(names, rows, strict=True) for _ in range(len(part))]
    columns = {"illumination": pa.array(illumination, pa.string())}
    columns |= {c: pa.array(table[:, k]) for k, c in enumerate(COLUMNS)}
    about = {"frame": FRAME, "lobe": "weight * exp(sharpness * (dot(direction, axis) - 1))", "illuminations": names}
    metadata = {"factorlib": json.dumps(about, sort_keys=True, ensure_ascii=False)}
    with writing(path):
        pq.write_table(pa.table(columns, metadata=metadata), path, compression="zstd")


def read_lobes(path: str | Path, cure: str = CURE) -> dict[str, Lobes]:
    """Read the lobes by illumination; InputError for a file that `write_lobes` did not write."""
    columns, about = read_columns(path, WHAT, ("illumination", *COLUMNS), cure=cure)
    with reading(WHAT, path, cure=cure):
        names = msgspec.convert(about["illuminations"], list[str])
        numbers = [columns[c].cast(pa.float64()).to_numpy(zero_copy_only=False) for c in COLUMNS]
        values = np.column_stack(numbers).reshape(-1, len(COLUMNS))
        illumination = np.array(columns["illumination"].to_pylist(), dtype=object)
        if not set(illumination) <= set(names):
            raise ValueError("a lobe belongs to an illumination that the metadata do not name")
    parts = {name: values[illumination == name] for name in names}
    return {name: Lobes(part[:, :3].copy(), part[:, 3].copy(), part[:, 4:].copy()) for name, part in parts.items()}


def read_photo_light(folder: Path, photo: str, light: LightSlice) -> Lobes:
    """Read the light of a photo in the photo's own camera axes, with its exposure applied; dark if it is unknown.

    Args:
        folder: the folder of the result of `solve` or `export`, in whose gauge the light is
        photo: name of the photo
        light: the photo's illumination and rotation
    """
    lobes = read_lobes(folder / "lobes.parquet").get(light.illumination, no_lobes())
    if len(lobes) == 0:
        log.warning("%s: nothing is known of its light: its pictures are black", photo)
    if light.world_from_camera is not None:
        lobes = lobes.rotate(np.array(light.world_from_camera).T)
    return lobes.scale(np.array(read_exposures(folder / "exposures.json").get(photo, 1.0)))
