"""YAML is read as YAML 1.2 says, and every complaint says where and what to do."""

import math
from typing import Annotated, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorlib.yamlfile import load_yaml, parse_yaml, read_yaml
from tests.faults.sample import put
from tests.refusal import refusal


class Inner(msgspec.Struct, forbid_unknown_fields=True):
    size: Annotated[int, msgspec.Meta(ge=1)]
    name: str = ""


class Outer(msgspec.Struct, forbid_unknown_fields=True):
    ratio: float
    table: dict[str, Inner] = {}
    rows: list[Inner] = []
    either: Inner | str | None = None
    mode: Literal["auto", "off"] = "auto"


@pytest.mark.parametrize(
    "text, value",
    [
        ("1e-3", 0.001), ("1.", 1.0), (".5", 0.5), ("-.inf", -math.inf), ("+12e03", 12000.0), ("12", 12), ("-7", -7), ("0x1F", 31), ("0o17", 15),
        ("017", 17), ("true", True), ("False", False), ("~", None), ("", None), ("no", "no"), ("on", "on"), ("1_000", "1_000"), ("2024-01-02", "2024-01-02"),
        ("'1'", "1"), ("[a, {b: 1}]", ["a", {"b": 1}]), ("{1: a, true: b}", {"1": "a", "true": "b"}), ("1:30", "1:30"),
    ],
)  # fmt: skip
def test_scalars_are_those_of_yaml_1_2(text, value):
    result = parse_yaml(text)
    assert result == value and type(result) is type(value)


@given(st.floats(allow_nan=False))
def test_every_float_that_python_writes_comes_back(number):
    assert parse_yaml(repr(number).replace("inf", ".inf")) == number


def test_a_good_file(tmp_path):
    text = "ratio: 1e-3\ntable: {a: &one {size: 2}, b: *one}\nrows: [{size: 1, name: no}]\n"
    file = put(tmp_path / "x.yaml", text)
    assert read_yaml(file, Outer) == Outer(0.001, {"a": Inner(2), "b": Inner(2)}, [Inner(1, "no")])
    assert load_yaml(file)["table"]["b"] == {"size": 2}


@pytest.mark.parametrize(
    "text, line, key, words",
    [
        ("ratio: 1\nratoi: 2\n", 2, "ratoi", "did you mean 'ratio'"),
        ("ratio: 1\ntable:\n  a: {size: 1}\n  b: {sise: 1, size: 1}\n", 4, "table.b.sise", "did you mean 'size'"),
        ("ratio: 1\nrows:\n- size: 1\n- size: 1\n  nam: x\n", 5, "rows[1].nam", "did you mean 'name'"),
        ("ratio: 1\neither: {siz: 1}\n", 2, "either.siz", "did you mean 'size'"),
        ("ratio: 1\nratio: 2\n", 2, "ratio", "twice, first on line 1"),
        ("ratio: 1\ntable: {a: {size: 1}, a: {size: 2}}\n", 2, "table.a", "twice"),
        ("ratio: 1\nrows:\n- {size: 0}\n", 3, "rows[0].size", ">= 1"),
        ("ratio: 1\ntable:\n  ok: {size: 1}\n  bad: {size: 1, name: 7}\n", 4, "table.bad.name", '"7"'),
        ("ratio: one\n", 1, "ratio", "'one'"),
        ("ratio: 1\nmode: on\n", 2, "mode", "one of auto, off"),
        ("table: {}\n", 1, None, "'ratio' is missing"),
        ("ratio: 1\nrows: [\n", 3, None, "not YAML"),
        ("ratio: 1\nrows: &a [*a]\n", 2, "rows[0][0][0]", "nested more than 64 deep"),
        ("ratio: !!python/name:os.system x\n", 1, "ratio", "tag"),
        ("ratio: 1\n? [a, b]\n: 2\n", 2, None, "a key is a list or a map, not a word"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_with_its_place(tmp_path, text, line, key, words):
    error = refusal(".", read_yaml, put(tmp_path / "x.yaml", text), Outer)
    assert (str(error.file), error.key) == (f"{tmp_path}/x.yaml:{line}", key)
    assert words in str(error)


def test_files_that_cannot_be_read(tmp_path):
    refusal("cannot be read", read_yaml, tmp_path / "none.yaml", Outer)
    refusal("UTF-8", read_yaml, put(tmp_path / "x.yaml", b"ratio: \xff"), Outer)
