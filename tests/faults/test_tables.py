"""Parquet and JSON of an earlier result, damaged or made up: refused, before memory is taken for what they announce."""

import json
import os
import time

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from factorlib.errors import InputError
from factorlib.jsonfile import read_json
from factorlib.light.lobes import Lobes
from factorlib.results.lobes import read_lobes, write_lobes
from factorlib.urm.observations import read_observations, write_observations
from tests.faults.test_fuzz import observations


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"material": np.full(5, 1)}, "'material' points beyond the names"),
        ({"photo": np.full(5, -1)}, "'photo' points beyond the names"),
        ({"illumination": np.full(5, 7)}, "'illumination' points beyond the names"),
        ({"exposures": (1.0, 2.0)}, "exposures"),
    ],
)
def test_observations_that_nothing_can_show(tmp_path, wrong, words):
    write_observations(tmp_path / "a.parquet", msgspec.structs.replace(observations(), **wrong))
    with pytest.raises(InputError, match=words) as caught:
        read_observations(tmp_path / "a.parquet")
    assert "urm" in caught.value.cure


def rewritten(path, **columns):
    table = pq.read_table(path)
    for name, column in columns.items():
        table = table.drop_columns(name) if column is None else table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, path)


@pytest.mark.parametrize(
    "columns, words",
    [
        ({"weight": None}, "0 columns 'weight'"),
        ({"weight": pa.array([1.0, None, 1.0, 1.0, 1.0])}, "'weight' has empty places"),
        ({"weight": pa.array(["a"] * 5)}, "of type string"),
        ({"x": pa.array([10**12] * 5)}, "not readable"),
        ({"normal": pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(10)), 2)}, "'normal' is of type"),
        ({"normal": pa.array([1.0] * 5)}, "not readable"),
        ({"visibility": pa.array([b"x" * 10_000] * 5, pa.binary(10_000))}, "'visibility' is of type"),
    ],
)
def test_columns_that_are_none(tmp_path, columns, words):
    write_observations(tmp_path / "a.parquet", observations())
    rewritten(tmp_path / "a.parquet", **columns)
    with pytest.raises(InputError, match=words):
        read_observations(tmp_path / "a.parquet")


def test_a_kilobyte_that_stands_for_gigabytes(tmp_path):
    """200 million rows of one number."""
    zero = pa.array(np.zeros(10_000_000))
    schema = pa.schema({"illumination": pa.float64()}, metadata={"factorlib": "{}"})
    with pq.ParquetWriter(tmp_path / "a.parquet", schema, compression="zstd") as writer:
        for _ in range(20):
            writer.write_table(pa.table({"illumination": zero}, schema=schema))
    begin = time.process_time()
    with pytest.raises(InputError, match="200,000,000 rows, more than 100,000,000"):
        read_lobes(tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 1_000_000 and time.process_time() - begin < 2


def test_a_lobe_of_an_illumination_that_is_not_named(tmp_path):
    write_lobes(tmp_path / "a.parquet", {"hall": Lobes(np.eye(3), np.ones(3), np.ones((3, 3)))})
    table = pq.read_table(tmp_path / "a.parquet")
    pq.write_table(table.replace_schema_metadata({"factorlib": json.dumps({"illuminations": ["room"]})}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="an illumination that its metadata do not name"):
        read_lobes(tmp_path / "a.parquet")


@pytest.mark.parametrize("read", [read_observations, read_lobes, read_json])
def test_a_pipe_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "a")
    with pytest.raises(InputError, match="is a pipe"):
        read(tmp_path / "a")


@pytest.mark.parametrize("content", ["[" * 100_000, "1" * 5000, "", "\x00", "{'a': 1}"], ids=range(5))
def test_a_json_that_is_none(tmp_path, content):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match="not readable as JSON"):
        read_json(tmp_path / "a.json")
