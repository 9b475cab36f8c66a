"""Observations of materials in photos: one row per pixel (or per merged group of pixels), as a struct of arrays.

The Parquet form is fixed (docs/formats.md): all vectors in the camera frame, radiance linear. The names behind the
indices and the units are in the schema metadata under the key `factorlib`.

Five columns are optional. `visibility` is there if some observation does not see every direction. It has K bytes: the
visible share of each direction of `fibonacci_sphere(K)`, 0 to 255. `met`, beside it, tells which surface hides a
direction. `confidence` is the confidence of each normal; `weight` is the same until observations are sampled or merged.
`place` is the position of the point, as defined in `factorlib.light.distance`; `object` the number of its object.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from factorlib.conventions import half_of_normal_and_view
from factorlib.errors import InputError
from factorlib.geometry.sphere import BINS, NO_OCCLUDER
from factorlib.parquetfile import read_columns
from factorlib.reading import reading
from factorlib.wholefile import writing

WHAT = "a reflectance map"
CURE = "run the stage `urm` again"
VISIBILITY = (
    "one byte per direction k of K, 0 hidden by an object to 255 seen; direction k, camera frame: z = 1 − (2k+1)/K, "
    "azimuth about z from x toward y = k π (3 − √5)"
)
MET = (
    f"two bytes (uint16, little-endian) per direction k of `visibility`: the surface that hides it, number in "
    f"`materials` · {BINS} + number of the direction of {BINS}, placed as those of `visibility`, that is nearest to "
    f"its normal; {NO_OCCLUDER}: none, or not known"
)
UNITS = {
    "frame": "camera: OpenCV, x right, y down, z forward; half = (2(n·o)n − o + (0,0,−1))/2; view points toward the "
    "camera",
    "units": {"radiance": "linear, scene-referred, Rec. 709, unknown exposure per photo"}
    | dict.fromkeys(("x", "y", "weight"), "pixels"),
}


class Observations(msgspec.Struct, frozen=True):
    """Observations of materials in photos, one a row.

    normal        unit, camera frame
    view          unit, toward the camera
    radiance      linear Rec. 709
    clipped       True for a channel whose radiance is a lower bound
    material      index in `materials`; likewise photo and illumination
    x, y          pixel
    weight        number of pixels that the row stands for, times their confidence
    visibility    visible share of each of k directions, 0 to 255; None if all are visible
    occluder      codes of the surfaces that hide directions (`factorlib.geometry.sphere`); the file's column `met`
    exposures     t·S/N² of each photo from EXIF, None if it is unknown
    confidence    confidence of the normal, 0 to 1
    place         position as in `factorlib.light.distance`
    object        number of the object in its photo, from 1
    detail        factor on the diffuse reflectance
    given_normal  normal of the mesh as given, where `normal` is another; cells are made of it (`cell_normal`)
    """

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
    visibility: UInt8[np.ndarray, "n k"] | None = None  # 255: the direction is visible; None: all are
    occluder: UInt16[np.ndarray, "n k"] | None = None  # codes of `geometry.occluder_codes`; needs `visibility`
    exposures: tuple[float | None, ...] = ()  # t·S/N² of `photos` from EXIF, None if unknown; empty if all are unknown
    confidence: Float[np.ndarray, " n"] | None = None  # confidence of the normal, 0 to 1; None: all are equal
    place: Float[np.ndarray, "n 3"] | None = None  # camera frame, about the photo's middle, RMS 1 (light.distance)
    object: Int[np.ndarray, " n"] | None = None  # number in the photo, from 1, as in `align`; None: one object
    detail: Float[np.ndarray, "n 3"] | None = None  # factor on diffuse reflectance, never written; None: 1
    given_normal: Float[np.ndarray, "n 3"] | None = None  # never written; None: `normal` is that of the mesh

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def half_vector(self) -> Float[np.ndarray, "n 3"]:
        """Half vector of the paper, (2(n·o)n − o + (0, 0, −1)) / 2, camera frame, from normals and views as float32."""
        return half_of_normal_and_view(self.normal.astype("f4").astype("f8"), self.view.astype("f4").astype("f8"))

    @property
    def cell_normal(self) -> Float[np.ndarray, "n 3"]:
        """Normal of the mesh as given.

        Cells of directions are made of it, because the last bits of an estimated normal must not decide which
        observations are merged, drawn or held out.
        """
        return self.normal if self.given_normal is None else self.given_normal

    def take(self, rows: np.ndarray) -> Observations:
        """Select the observations of `rows` (indices or a mask), with the same names."""
        columns = {name: getattr(self, name) for name in (*COLUMNS, *WIDE, *OPTIONAL, "detail", "given_normal")}
        selected = {name: values[rows] for name, values in columns.items() if values is not None}
        return msgspec.structs.replace(self, **selected)


# types of the required columns
COLUMNS = {
    "normal": "f4",
    "view": "f4",
    "radiance": "f4",
    "clipped": "?",
    "material": "i2",
    "photo": "i4",
    "illumination": "i4",
    "x": "i4",
    "y": "i4",
    "weight": "f4",
}
VECTORS = ("normal", "view", "radiance", "clipped", "place")
OPTIONAL = {"confidence": "f4", "place": "f4", "object": "i2"}  # types of the optional columns
# tuples of names, and the columns of indices into them
NAMES = {
    "materials": "material",
    "photos": "photo",
    "illuminations": "illumination",
}
# optional columns of K values a row, by attribute: column, type, value if everything is visible, meaning
WIDE: dict[str, tuple[str, np.dtype, int, str]] = {
    "visibility": ("visibility", np.dtype("u1"), 255, VISIBILITY),
    "occluder": ("met", np.dtype("<u2"), NO_OCCLUDER, MET),
}


def write_observations(path: str | Path, observations: Observations) -> None:
    """Write the fixed Parquet columns, and the optional ones that are present."""
    columns = {}
    for name, dtype in {"normal": "f4", "half": "f4", **COLUMNS, **OPTIONAL}.items():
        if (values := getattr(observations, "half_vector" if name == "half" else name)) is not None:
            values = np.ascontiguousarray(values, dtype=dtype)
            flat = pa.array(values.reshape(-1))
            columns[name] = pa.FixedSizeListArray.from_arrays(flat, 3) if values.ndim == 2 else flat
    about = {**UNITS, **{kind: getattr(observations, kind) for kind in NAMES}}
    if any(exposure is not None for exposure in observations.exposures):
        about["exposures"] = observations.exposures
    for attribute, (name, wide, _, meaning) in WIDE.items():
        if (values := getattr(observations, attribute)) is not None:
            data = pa.py_buffer(np.ascontiguousarray(values, dtype=wide))
            type_ = pa.binary(values.shape[1] * wide.itemsize)  # the values of a row as one binary of fixed size
            columns[name] = pa.FixedSizeBinaryArray.from_buffers(type_, len(values), [None, data])
            about[name] = meaning
    metadata = {"factorlib": json.dumps(about, sort_keys=True, ensure_ascii=False)}
    with writing(path):
        pq.write_table(pa.table(columns, metadata=metadata), path, compression="zstd")


def read_observations(path: str | Path) -> Observations:
    """Read a file of `write_observations`.

    Raises:
        InputError: If it is any other Parquet file.
    """
    parts, about = read_columns(path, WHAT, COLUMNS, (*OPTIONAL, *(name for name, *_ in WIDE.values())), CURE)
    with reading(WHAT, path, cure=CURE):
        narrow = {name: dtype for name, dtype in (COLUMNS | OPTIONAL).items() if name in parts}
        fields: dict[str, Any] = {name: _array(parts[name], dtype, name in VECTORS) for name, dtype in narrow.items()}
        wide = {attribute: (parts[name], dtype) for attribute, (name, dtype, *_) in WIDE.items() if name in parts}
        fields |= {attribute: _rows_of_bytes(*column) for attribute, column in wide.items()}
        fields |= {kind: tuple(msgspec.convert(about[kind], list[str])) for kind in NAMES}
        exposures = tuple(msgspec.convert(about.get("exposures", []), list[float | None]))
        observations = Observations(**fields, exposures=exposures)
        _check(observations)
    return observations


def _check(observations: Observations) -> None:
    """Raise ValueError for an index without a name or a value out of range.

    Values that are not finite, or of no weight, are allowed: the solve excludes and counts them.
    """
    for kind, name in NAMES.items():
        index = getattr(observations, name)
        known = getattr(observations, kind)
        if len(index) and not 0 <= index.min() <= index.max() < len(known):
            raise ValueError(f"column {name!r} has an index without a name in the metadata")
    if observations.exposures and len(observations.exposures) != len(observations.photos):
        raise ValueError("the metadata do not have one exposure for each photo")
    confidence = observations.confidence
    if confidence is not None and not ((confidence >= 0) & (confidence <= 1)).all():
        raise ValueError("column 'confidence' has a value outside 0 to 1")
    if observations.place is not None and not np.isfinite(observations.place).all():
        raise ValueError("column 'place' has a value that is not finite")
    if observations.occluder is not None:
        if observations.visibility is None or observations.visibility.shape != observations.occluder.shape:
            raise ValueError("column 'met' does not have one code per direction of 'visibility'")
        known = observations.occluder[observations.occluder != NO_OCCLUDER]
        if len(known) and known.max() >= BINS * len(observations.materials):
            raise ValueError("column 'met' has the code of a material without a name in the metadata")


def concatenate(parts: Sequence[Observations]) -> Observations:
    """Concatenate observations, with indices renumbered over the sorted union of names.

    The order of `parts` changes no index.

    Raises:
        InputError: If the parts have different materials or numbers of directions.
    """
    parts = sorted(parts, key=lambda part: part.photos)
    cure = "run the stage `urm` again for all photos"
    materials = parts[0].materials
    if any(part.materials != materials for part in parts):
        raise InputError("the observations of the photos have different lists of materials", cure=cure)
    fields: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
    if any(part.given_normal is not None for part in parts):
        fields["given_normal"] = np.concatenate([part.cell_normal for part in parts])
    # renumber photos and illuminations over the sorted union of names
    for kind, column in (("photos", "photo"), ("illuminations", "illumination")):
        fields[kind] = tuple(sorted({name for part in parts for name in getattr(part, kind)}))
        numbers = [np.array([fields[kind].index(name) for name in getattr(part, kind)], "i4") for part in parts]
        indices = [getattr(part, column) for part in parts]
        renumbered = [new[index] if len(new) else index for new, index in zip(numbers, indices, strict=True)]
        fields[column] = np.concatenate(renumbered).astype("i4")
    exposures = {photo: exposure for part in parts for photo, exposure in zip(part.photos, part.exposures)}
    fills = {name: (dtype, nothing) for name, (_, dtype, nothing, _) in WIDE.items()}
    fills |= {"confidence": (np.dtype("f4"), 1), "place": (np.dtype("f4"), 0), "detail": (np.dtype("f4"), 1)}
    fills["object"] = (np.dtype("i2"), 1)
    # optional columns: parts without them get full visibility, full confidence, the origin as place, and one object
    for name, (dtype, fill) in fills.items():
        columns = [getattr(part, name) for part in parts]
        shapes = {values.shape[1:] for values in columns if values is not None}
        if len(shapes) > 1:
            counts = sorted(count for (count,) in shapes)
            fault = f"the photos have different numbers of directions in {name!r}: {counts[0]} and {counts[1]}"
            raise InputError(fault, cure=cure)
        for shape in shapes:
            filled = [
                np.full((len(part), *shape), fill, dtype) if values is None else values
                for part, values in zip(parts, columns)
            ]
            fields[name] = np.concatenate(filled)
    fields["exposures"] = tuple(exposures.get(photo) for photo in fields["photos"])
    return Observations(**fields, materials=materials)


def with_exposures(observations: Observations, known: Mapping[str, float]) -> Observations:
    """Replace exposures of EXIF by those that are known, in EV by photo."""
    if not known:
        return observations
    exif = observations.exposures or (None,) * len(observations.photos)
    exposures = (
        2.0 ** known[photo] if photo in known else value for photo, value in zip(observations.photos, exif, strict=True)
    )
    return msgspec.structs.replace(observations, exposures=tuple(exposures))


def relative_exposures(observations: Observations) -> dict[str, float]:
    """Return the exposure of each photo with observations, relative to the first photo (by name) of its light.

    It is 1 unless the exposures of all photos of the light are known. Two photos of one light differ by a factor, which
    the solve estimates. From a factor of 8 it may not converge. EXIF's t·S/N² is right within rounding and within the
    changes of a camera's own rendering. So radiance is brought to the exposure of the light's first photo by EXIF, and
    the solve estimates the rest.
    """
    known = dict(zip(observations.photos, observations.exposures))
    relative: dict[str, float] = {}
    for light in np.unique(observations.illumination):
        numbers = np.unique(observations.photo[observations.illumination == light])
        photos = sorted(observations.photos[k] for k in numbers)
        exposures = [exposure for photo in photos if (exposure := known.get(photo)) is not None]
        is_complete = len(exposures) == len(photos) and exposures[0]
        ratios = [exposure / exposures[0] for exposure in exposures] if is_complete else [1.0] * len(photos)
        relative |= dict(zip(photos, ratios))
    return relative


def at_one_exposure(observations: Observations, relative: dict[str, float]) -> Observations:
    """Divide the radiance of each photo by its relative exposure; all factors of 1 change nothing."""
    factors = np.array([relative.get(photo, 1.0) for photo in observations.photos])
    if (factors == 1).all():
        return observations
    return msgspec.structs.replace(observations, radiance=observations.radiance / factors[observations.photo][:, None])


def _rows_of_bytes(column: pa.Array, dtype: np.dtype) -> np.ndarray:
    """Convert a column of fixed-size binaries to one row of values each; ValueError for a fraction of a value."""
    k, over = divmod(column.type.byte_width, dtype.itemsize)
    if over:
        raise ValueError(f"a binary of {column.type.byte_width} bytes does not hold numbers of {dtype.itemsize} bytes")
    return np.frombuffer(column.buffers()[1], dtype).reshape(-1, k)[column.offset : column.offset + len(column)].copy()


def _array(column: pa.Array, dtype: str, is_vector: bool) -> np.ndarray:
    """Convert a column to an array of the type `dtype`; ValueError for values that do not fit into it."""
    if pa.types.is_fixed_size_list(column.type) != is_vector or pa.types.is_string(column.type):
        raise ValueError(f"a column is of type {column.type}, not {'vectors of three ' if is_vector else ''}{dtype}")
    flat = column.flatten() if is_vector else column
    values = flat.cast(pa.from_numpy_dtype(np.dtype(dtype))).to_numpy(zero_copy_only=False)
    return values.reshape(-1, 3) if is_vector else values
