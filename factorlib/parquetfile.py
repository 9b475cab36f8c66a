"""Parquet on disk: named columns of numbers, with this project's metadata in the schema.

The header of a file is checked before its columns are read, because a kilobyte of Parquet can stand for gigabytes of
one number.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from factorlib.reading import check_plain, reading
from factorlib.wholefile import writing

MOST_ROWS = 100_000_000
MOST_BYTES = 8192  # bytes of one value: one for each direction of visibility


def read_columns(
    path: str | Path,
    kind: str,
    needed: Iterable[str],
    optional: Iterable[str] = (),
    cure: str = "",
    most_rows: int = MOST_ROWS,
) -> tuple[dict[str, pa.Array], dict[str, Any]]:
    """Read columns by name, without nulls, and the metadata `factorlib`; other columns are not read.

    Args:
        path: the file
        kind: the kind of file with its article, for messages
        needed: names of required columns
        optional: names of columns to read if they exist
        cure: cure for a rejected file
        most_rows: largest number of rows

    Raises:
        InputError: The file is not Parquet, has too many rows, or lacks a needed column.
    """
    check_plain(path, kind, most_bytes=None)
    with reading(kind, path, cure=cure, also=(pa.ArrowException,)), pq.ParquetFile(path) as file:
        schema = file.schema_arrow
        if file.metadata.num_rows > most_rows:
            raise ValueError(f"it has {file.metadata.num_rows:,} rows; at most {most_rows:,} are read")
        names = [*needed, *(name for name in optional if name in schema.names)]
        for name in names:
            if schema.names.count(name) != 1:
                raise ValueError(f"it has {schema.names.count(name)} columns {name!r}, and needs one")
            if not _is_readable(column_type := schema.field(name).type):
                expected = f"numbers, vectors of three, text, or up to {MOST_BYTES} bytes a row are read"
                raise ValueError(f"column {name!r} is of type {column_type}; {expected}")
        table = file.read(columns=names)
        columns = {name: table[name].combine_chunks() for name in names}
        for name, column in columns.items():
            if column.null_count or (pa.types.is_fixed_size_list(column.type) and column.flatten().null_count):
                raise ValueError(f"column {name!r} has missing values")
            column.validate(full=True)
        about = json.loads((schema.metadata or {})[b"factorlib"])
        if not isinstance(about, dict):
            raise ValueError("its metadata `factorlib` is not a JSON object")
    return columns, about


def write_rows(path: str | Path, type_: type[msgspec.Struct], rows: Sequence[msgspec.Struct]) -> None:
    """Write a column for each field of the rows.

    Args:
        path: the file
        type_: type of the rows
        rows: structs of that type
    """
    columns = {name: [getattr(row, name) for row in rows] for name in type_.__struct_fields__}
    with writing(path):
        pq.write_table(pa.table(columns), path, compression="zstd")


def _is_readable(kind: pa.DataType) -> bool:
    """Return True if a column holds numbers, lists of three of them, text, or bytes of a fixed length."""
    is_list = pa.types.is_fixed_size_list(kind)
    value_type = kind.value_type if is_list else kind
    if pa.types.is_integer(value_type) or pa.types.is_floating(value_type) or pa.types.is_boolean(value_type):
        return not is_list or kind.list_size == 3
    return pa.types.is_string(kind) or (pa.types.is_fixed_size_binary(kind) and 0 < kind.byte_width <= MOST_BYTES)
