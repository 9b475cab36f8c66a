"""The boundary of readers: what a parser raises is an InputError with file, key and cure."""

import struct
import time
from typing import Annotated

import msgspec
import pytest
import yaml

from factorlib.errors import InputError
from factorlib.reading import path_inside, read_text, reading
from factorlib.yamlfile import parse_yaml, read_yaml


@pytest.mark.parametrize("error, words", [
    (PermissionError(13, "Permission denied"), "cannot be read (Permission denied)"),
    (RecursionError("maximum recursion depth exceeded"), "nested too deeply"),
    (MemoryError(), "does not fit into memory"),
    (OverflowError("int too large\nto convert"), "(int too large to convert)"),
    (KeyError("nodes"), "(KeyError: 'nodes')"),
    (struct.error("unpack requires 4 bytes"), "(unpack requires 4 bytes)"),
    (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "invalid start byte"),
    (ModuleNotFoundError("No module named 'x'"), "No module named 'x'"),
])  # fmt: skip
def test_what_a_parser_raises_names_file_key_and_cure(error, words):
    with pytest.raises(InputError) as caught, reading("a mesh", "chair.obj", "meshes.chair.file"):
        raise error
    assert words in caught.value.found and "\n" not in caught.value.found
    assert caught.value.file == "chair.obj" and caught.value.key == "meshes.chair.file" and caught.value.cure


@pytest.mark.parametrize("error", [InputError("part without material", file="a.obj"), KeyboardInterrupt()])
def test_a_clear_error_passes_as_it_is_and_a_stop_too(error):
    with pytest.raises(type(error)) as caught, reading("a mesh", "b.obj"):
        raise error
    assert caught.value is error


def test_texts_and_paths(tmp_path):
    (tmp_path / "latin").write_bytes("Möbel".encode("latin-1"))
    with pytest.raises(InputError, match=r"not UTF-8 text \(byte 1\)"):
        read_text(tmp_path / "latin", "a list")
    assert path_inside(tmp_path, "a/../b c/ü.png") == tmp_path / "a/../b c/ü.png", "up and down again"


class Numbered(msgspec.Struct):
    table: dict[str, Annotated[float, msgspec.Meta(ge=0)]] = {}


def test_a_wrong_value_among_thousands_is_named_in_a_moment(tmp_path):
    """msgspec does not say which key of a table is wrong."""
    file = tmp_path / "x.yaml"
    file.write_text("table:\n" + "".join(f"  k{i}: {'one' if i == 7000 else i}\n" for i in range(10_000)))
    began = time.process_time()
    with pytest.raises(InputError) as caught:
        read_yaml(file, Numbered)
    assert caught.value.key == "table.k7000" and caught.value.file == f"{file}:7002"
    assert time.process_time() - began < 10


GOOD = ["a: &x 1\nb: [*x, *x]", "a: !!str 5\nb: !!float 5", "", "---\na: 1\n...\n", "{a: &b {c: 1}, d: {e: *b}}"]


@pytest.mark.parametrize("text", GOOD)
def test_yaml_that_is_good_is_read_as_by_pyyaml(text):
    assert parse_yaml(text, "x.yaml") == yaml.safe_load(text)
