"""Mesh files spoiled at random: whatever is in a file, it is read or refused by an InputError, soon and in little memory.

What an earlier search found stands as tests in `test_meshes.py`.
"""

from __future__ import annotations

import json
import os
import resource
import warnings
from collections import Counter
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from faults.mesh_files import GOOD, glb, gltf_text
from faults.tries import note
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorlib.dataset.check import Refusal
from factorlib.dataset.companions import companions_of_mesh
from factorlib.errors import InputError
from factorlib.meshes import Mesh, read_mesh

LONG = int(os.environ.get("FUZZ_SECONDS", "600"))
NUMBERS = [
    "0",
    "1",
    "-1",
    "4",
    "5",
    "1e300",
    "-1e300",
    "1e-300",
    "1e999",
    "nan",
    "inf",
    "1" * 30,
    "9" * 5000,
    "4294967295",
    "1e15",
    "2.5",
    "",
    "x",
    "²",
    "\0",
]
NUMBERS += ["1000000000000", "-9223372036854775808", "18446744073709551616"]
WORDS = [
    "v",
    "vn",
    "f",
    "usemtl",
    "g",
    "o",
    "mtllib",
    "element",
    "property",
    "list",
    "uchar",
    "uint",
    "float",
    "vertex",
    "face",
    "end_header",
    "format",
]
WORDS += [
    "comment",
    "OFF",
    "COFF",
    "BINARY",
    "solid",
    "endsolid",
    "facet",
    "ascii",
    "binary_big_endian",
    "#",
    "\\",
    "1/2/3",
    "1//",
    "//",
    "a" * 300,
    "ü",
    "../x",
]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-2, 9) | st.sampled_from([2**31, 2**53, 10**30, 1e300, -1, 5126, 5123, 0.5]) | st.floats()
    | st.sampled_from(["", "x", "2.0", "VEC3", "SCALAR", "POSITION", "NORMAL", "a%00b", "data:;base64,AAAA", "data:,x", "../a", "\ud800", "b.bin", "a" * 300]),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.sampled_from(["nodes", "mesh", "children", "buffer", "count", "POSITION", "uri", "sparse", "indices"]), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@st.composite
def spoiled_bytes(draw, content: bytes) -> bytes:
    """A file with bytes changed, cut out, doubled or put in; cut at the end at times."""
    for _ in range(draw(st.integers(1, 4))):
        at, length = draw(st.integers(0, len(content))), draw(st.sampled_from([0, 1, 2, 4, 8, 40]))
        new = draw(
            st.binary(max_size=8) | st.sampled_from([b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"\0\0\xc0\x7f", content[at : at + 60]])
        )
        content = content[:at] + new + content[at + length :]
    return content[: draw(st.integers(0, len(content)))] if draw(st.integers(0, 9)) == 0 else content


@st.composite
def spoiled_words(draw, content: bytes) -> bytes:
    """A text with words and lines replaced, moved and removed."""
    lines = [line.split(b" ") for line in content.split(b"\n")]
    for _ in range(draw(st.integers(1, 5))):
        line = draw(st.integers(0, len(lines) - 1))
        word = draw(st.integers(0, max(len(lines[line]) - 1, 0)))
        kind = draw(st.sampled_from(["number", "number", "number", "word", "word", "move", "remove", "cut", "text"]))
        if kind in ("number", "word", "text"):
            new = draw(st.sampled_from(NUMBERS if kind == "number" else WORDS) if kind != "text" else st.text(max_size=9))
            lines[line][word : word + 1] = [new.encode("utf-8", "replace") if draw(st.booleans()) else new.encode("latin-1", "replace")]
        elif kind == "move":
            lines.insert(draw(st.integers(0, len(lines))), list(lines[line]))
        elif kind == "remove" and len(lines) > 1:
            del lines[line]
        else:
            del lines[line][word:]
    return draw(st.sampled_from([b"\n", b"\n", b"\r\n", b"\r"])).join(b" ".join(words) for words in lines)


@st.composite
def spoiled_json(draw) -> str:
    """A glTF header with values of any kind at places of any depth."""
    tree = json.loads(gltf_text())
    for _ in range(draw(st.integers(1, 3))):
        place, key = tree, draw(st.sampled_from(sorted(tree)))
        while isinstance(place[key], (dict, list)) and place[key] and draw(st.integers(0, 4)):
            place = place[key]
            key = draw(st.sampled_from(sorted(place))) if isinstance(place, dict) else draw(st.integers(0, len(place) - 1))
        if draw(st.integers(0, 5)):
            place[key] = draw(JSON)
        elif isinstance(place, dict) and len(tree) > 1:
            del place[key]
        if not isinstance(tree, dict) or not tree:
            break
    return json.dumps(tree)


def spoiled(name: str) -> st.SearchStrategy:
    content = GOOD[name]
    if name == "whole.gltf":
        return spoiled_json().map(str.encode) | spoiled_bytes(content)
    if name == "whole.glb":
        return spoiled_json().map(glb) | spoiled_bytes(content)
    if name in ("binary.stl", "binary.ply"):
        return spoiled_bytes(content)
    return spoiled_words(content) | spoiled_bytes(content)


CAME = Counter()  # of the meshes so far: how many were read, how many refused


def attempt(folder: Path, name: str, content: bytes) -> None:
    """Read it as the dataset's reader and the stages do."""
    (folder / name).write_bytes(content)
    made_of = "red" if len(content) % 2 else {"red": "red", "shell": "red"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning that names our source is no word to a user
        for work in (
            lambda: companions_of_mesh(name, "meshes.a.file", Refusal(folder / "dataset.yaml", folder)),
            lambda: read_mesh(folder / name, ["red"], made_of),
        ):
            refused = False
            try:
                found = work()
            except InputError as error:
                check_clear(error)
                refused = True
            else:
                if isinstance(found, Mesh):
                    check_usable(found)
    CAME["refused" if refused else "accepted"] += 1


def check_clear(error: InputError) -> None:
    assert error.file is not None
    assert error.cure
    assert "\n" not in error.found
    assert len(error.found) < 600


def check_usable(mesh: Mesh) -> None:
    """What is read can be used: finite, unit normals, indices in range."""
    assert len(mesh.faces) and 0 <= mesh.faces.min() and mesh.faces.max() < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.radius) and mesh.radius > 0
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-6
    assert set(mesh.labels) == {1}


@pytest.fixture
def folder(tmp_path):
    """Where whoever opens a texture or a pipe would hang, and whoever fills memory stops."""
    os.mkfifo(tmp_path / "a.png")
    os.mkfifo(tmp_path / "b.bin")
    (tmp_path / "x").symlink_to("x")
    return tmp_path


QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large]


@pytest.mark.parametrize("name", GOOD)
def test_a_spoiled_mesh_is_read_or_refused(folder, name):
    @settings(max_examples=60, derandomize=True, deadline=timedelta(seconds=5), database=None, suppress_health_check=QUIET)
    @given(spoiled(name))
    def search(content):
        attempt(folder, name, content)

    CAME.clear()
    search()
    note("fuzz", name, CAME.total(), **CAME)


@pytest.mark.long
@pytest.mark.parametrize("name", GOOD)
def test_a_spoiled_mesh_is_read_or_refused_for_long(folder, name):
    """About ten minutes over all formats; FUZZ_SECONDS for another time."""
    import time

    end = time.monotonic() + LONG / len(GOOD)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    @settings(max_examples=2000, deadline=timedelta(seconds=5), database=None, suppress_health_check=QUIET)
    @given(spoiled(name))
    def search(content):
        if time.monotonic() < end:
            attempt(folder, name, content)

    CAME.clear()
    while time.monotonic() < end:
        search()
    note("fuzz", name, CAME.total(), **CAME)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB
