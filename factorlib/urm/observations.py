"""Observations of materials in photos: one row per pixel (or per merged group of pixels), as a struct of arrays.

The Parquet form is fixed (docs/formats.md): all vectors in the camera frame, radiance linear, the names behind the
indices and the units in the schema metadata under the key `factorlib`.

`visibility`, where some observation does not see every direction, is a further column of K bytes: the share of each
direction of `fibonacci_sphere(K)` that is seen, 0 to 255.  `met`, beside it, says which surface hides a direction.  `confidence`, which a file
need not have, says how sure each normal is; `weight` is the same until observations are sampled or merged.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from factorlib.conventions import half_of_normal_and_view
from factorlib.errors import InputError
from factorlib.geometry.met import BINS, UNMET
from factorlib.parquetfile import read_columns
from factorlib.reading import reading
from factorlib.wholefile import writing

VECTORS = ("normal", "view", "radiance", "clipped")
WHAT, CURE = "a reflectance map", "run the stage `urm` again"
VISIBILITY = (
    "one byte per direction k of K, 0 hidden by an object to 255 seen; direction k, camera frame: z = 1 − (2k+1)/K, "
    "azimuth about z from x toward y = k π (3 − √5)"
)
MET = (
    f"two bytes (uint16, little-endian) per direction k of `visibility`: the surface that hides it, number in `materials` · {BINS} + "
    f"number of the direction of {BINS}, placed as those of `visibility`, that is nearest to its normal; {UNMET}: none, or not known"
)
UNITS = {
    "frame": "camera: OpenCV, x right, y down, z forward; half = (2(n·o)n − o + (0,0,−1))/2; view points toward the camera",
    "units": {
        "radiance": "linear, scene-referred, Rec. 709, unknown exposure per photo",
        "x": "pixels",
        "y": "pixels",
        "weight": "pixels",
    },
}


class Observations(msgspec.Struct, frozen=True):
    """n observations of `materials` in `photos`; indices are positions in the tuples of names."""

    normal: Float[np.ndarray, "n 3"]
    view: Float[np.ndarray, "n 3"]  # unit, toward the camera
    radiance: Float[np.ndarray, "n 3"]
    clipped: Bool[np.ndarray, "n 3"]  # radiance is a lower bound
    material: Int[np.ndarray, " n"]
    photo: Int[np.ndarray, " n"]
    illumination: Int[np.ndarray, " n"]
    x: Int[np.ndarray, " n"]
    y: Int[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    materials: tuple[str, ...]
    photos: tuple[str, ...]
    illuminations: tuple[str, ...]
    visibility: UInt8[np.ndarray, "n k"] | None = None  # 255: that direction is seen; None: all are
    met: UInt16[np.ndarray, "n k"] | None = (
        None  # codes of what hides directions (geometry.met); with `visibility` alone
    )
    exposures: tuple[float | None, ...] = ()  # of `photos`, t·S/N² from EXIF, None where unknown; empty: all are
    confidence: Float[np.ndarray, " n"] | None = None  # of the normal, 0 to 1; None: all are as sure

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def half(self) -> Float[np.ndarray, "n 3"]:
        """The paper's half vector, (2(n·o)n − o + (0, 0, −1)) / 2, camera frame, of the stored float32 normals and views."""
        return half_of_normal_and_view(self.normal.astype("f4").astype("f8"), self.view.astype("f4").astype("f8"))

    def take(self, rows: np.ndarray) -> Observations:
        """The observations of `rows` (indices or a mask), with the same names."""
        further = {
            name: None if getattr(self, name) is None else getattr(self, name)[rows] for name in (*WIDE, *OPTIONAL)
        }
        return msgspec.structs.replace(self, **{name: getattr(self, name)[rows] for name in COLUMNS}, **further)


COLUMNS = ("normal", "view", "radiance", "clipped", "material", "photo", "illumination", "x", "y", "weight")
OPTIONAL = ("confidence",)  # columns that need not be there
WIDE = {"visibility": np.dtype("u1"), "met": np.dtype("<u2")}  # K values a row, where there are any
NOTHING = {"visibility": 255, "met": UNMET}  # of observations that see everything
DTYPES = {"normal": "f4", "view": "f4", "radiance": "f4", "clipped": "?", "material": "i2", "photo": "i4", "illumination": "i4",
          "x": "i4", "y": "i4", "weight": "f4", "confidence": "f4"}  # fmt: skip


def write_observations(path: str | Path, observations: Observations) -> None:
    """Write the fixed Parquet columns, and `confidence`, `visibility` and `met`, where there is one."""
    columns = {}
    given = [name for name in OPTIONAL if getattr(observations, name) is not None]
    for name in ("normal", "half", "view", "radiance", "clipped", *COLUMNS[4:], *given):
        dtype = DTYPES.get(name, "f4")
        values = np.ascontiguousarray(getattr(observations, name), dtype=dtype)
        flat = pa.array(values.reshape(-1))
        columns[name] = pa.FixedSizeListArray.from_arrays(flat, 3) if values.ndim == 2 else flat
    names = {
        "materials": observations.materials,
        "photos": observations.photos,
        "illuminations": observations.illuminations,
    }
    about = {**UNITS, **names}
    if any(exposure is not None for exposure in observations.exposures):
        about["exposures"] = observations.exposures
    for name, meaning in (("visibility", VISIBILITY), ("met", MET)):
        if (values := getattr(observations, name)) is not None:
            columns[name], about[name] = _bytes(values, WIDE[name]), meaning
    metadata = {"factorlib": json.dumps(about, sort_keys=True, ensure_ascii=False)}
    with writing(path):
        pq.write_table(pa.table(columns, metadata=metadata), path, compression="zstd")


def read_observations(path: str | Path) -> Observations:
    """Read what `write_observations` wrote; raises InputError for any other Parquet file."""
    parts, about = read_columns(path, WHAT, COLUMNS, (*OPTIONAL, *WIDE), CURE)
    with reading(WHAT, path, cure=CURE):
        columns = {
            name: _array(parts[name], DTYPES[name], name in VECTORS) for name in (*COLUMNS, *OPTIONAL) if name in parts
        }
        columns |= {name: _of_bytes(parts[name], dtype) for name, dtype in WIDE.items() if name in parts}
        named = {
            kind: tuple(msgspec.convert(about[kind], list[str])) for kind in ("materials", "photos", "illuminations")
        }
        exposures = tuple(msgspec.convert(about.get("exposures", []), list[float | None]))
        observations = Observations(**columns, **named, exposures=exposures)
        _check(observations)
    return observations


def _check(observations: Observations) -> None:
    """Raise ValueError for a number that names nothing; what is not finite, or weighs nothing, the solve leaves out and counts."""
    for name, known in (
        ("material", observations.materials),
        ("photo", observations.photos),
        ("illumination", observations.illuminations),
    ):
        index = getattr(observations, name)
        if len(index) and not 0 <= index.min() <= index.max() < len(known):
            raise ValueError(f"column {name!r} points beyond the names of the metadata")
    if observations.exposures and len(observations.exposures) != len(observations.photos):
        raise ValueError("its exposures are not one a photo")
    if (
        observations.confidence is not None
        and not ((observations.confidence >= 0) & (observations.confidence <= 1)).all()
    ):
        raise ValueError("column 'confidence' is not between 0 and 1")
    if observations.met is not None:
        if observations.visibility is None or observations.visibility.shape != observations.met.shape:
            raise ValueError("column 'met' has not the directions of a column 'visibility'")
        known = observations.met[observations.met != UNMET]
        if len(known) and known.max() >= BINS * len(observations.materials):
            raise ValueError("column 'met' points beyond the names of the metadata")


def concatenate(parts: Sequence[Observations]) -> Observations:
    """All observations of `parts`, indices renumbered over the sorted union of names: the order of parts changes no index."""
    parts = sorted(parts, key=lambda part: part.photos)
    materials = parts[0].materials
    if any(part.materials != materials for part in parts):
        raise InputError(
            "reflectance maps of different material lists", cure="run the stage `urm` again for all photos"
        )
    names = {
        kind: tuple(sorted({n for part in parts for n in getattr(part, kind)})) for kind in ("photos", "illuminations")
    }
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
    for kind, column in (("photos", "photo"), ("illuminations", "illumination")):
        renumbered = [_renumber(getattr(part, column), getattr(part, kind), names[kind]) for part in parts]
        columns[column] = np.concatenate(renumbered).astype("i4")
    exposures = {photo: exposure for part in parts for photo, exposure in zip(part.photos, part.exposures)}
    columns |= {name: _of_all(parts, name) for name in WIDE}
    if any(part.confidence is not None for part in parts):
        columns["confidence"] = np.concatenate(
            [np.ones(len(p), "f4") if p.confidence is None else p.confidence for p in parts]
        )
    return Observations(
        **columns, materials=materials, **names, exposures=tuple(exposures.get(p) for p in names["photos"])
    )


def _of_all(parts: Sequence[Observations], name: str) -> np.ndarray | None:
    """`visibility` or `met` of all parts; those without see everything."""
    counts = {getattr(part, name).shape[1] for part in parts if getattr(part, name) is not None}
    if len(counts) > 1:
        raise InputError(
            f"reflectance maps whose {name} has {sorted(counts)} directions",
            cure="run the stage `urm` again for all photos",
        )
    if not counts:
        return None
    (k,) = counts
    given = [getattr(part, name) for part in parts]
    return np.concatenate(
        [np.full((len(part), k), NOTHING[name], WIDE[name]) if own is None else own for part, own in zip(parts, given)]
    )


def _renumber(index: np.ndarray, old: Sequence[str], new: Sequence[str]) -> np.ndarray:
    return np.array([new.index(name) for name in old], dtype="i4")[index] if len(old) else index


def _bytes(values: np.ndarray, dtype: np.dtype) -> pa.Array:
    """A row's values as one binary of fixed size."""
    data = pa.py_buffer(np.ascontiguousarray(values, dtype=dtype))
    return pa.FixedSizeBinaryArray.from_buffers(pa.binary(values.shape[1] * dtype.itemsize), len(values), [None, data])


def _of_bytes(column: pa.Array, dtype: np.dtype) -> np.ndarray:
    """The inverse of `_bytes`; ValueError for bytes that are no whole values."""
    k, over = divmod(column.type.byte_width, dtype.itemsize)
    if over:
        raise ValueError(f"a binary of {column.type.byte_width} bytes holds no numbers of {dtype.itemsize}")
    return np.frombuffer(column.buffers()[1], dtype).reshape(-1, k)[column.offset : column.offset + len(column)].copy()


def _array(column: pa.Array, dtype: str, is_vector: bool) -> np.ndarray:
    """Of the type that it is written in; ValueError for values that do not fit into it."""
    if pa.types.is_fixed_size_list(column.type) != is_vector or pa.types.is_string(column.type):
        raise ValueError(f"a column is of type {column.type}")
    flat = column.flatten() if is_vector else column
    values = flat.cast(pa.from_numpy_dtype(np.dtype(dtype))).to_numpy(zero_copy_only=False)
    return values.reshape(-1, 3) if is_vector else values
