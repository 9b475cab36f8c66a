"""Faults of what meshes draw in, as the dataset's reader meets them: odd paths, pipes, links in circles, headers that are none."""

from __future__ import annotations

import json
import os

import pytest
import yaml
from faults.mesh_files import DATA, OBJ, glb, gltf_header, gltf_text, write

from factorlib.dataset.read import read_dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.errors import InputError


def make_set(folder, mesh: str, content: str | bytes):
    for name in ("p.jpg", "p.png"):
        write(folder, name, "")
    write(folder, mesh, content)
    photo = {"name": "p", "image": "p.jpg", "masks": "p.png", "objects": [{"name": "a", "mesh": "a"}]}
    spec = {"format": 1, "materials": ["red"], "meshes": {"a": {"file": mesh, "material": "red"}}, "photos": [photo]}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec))
    return folder


def companions(folder) -> list[str]:
    return read_dataset(folder).companions["a"]


ODD_PATHS = {
    "circle": "circle",
    "below a circle": "circle/a.bin",
    "NUL": "a\0b",
    "a long part": "b" * 256,
    "a long part in UTF-8": "ü" * 200,
    "a long path": "c/" * 3000,
    "outside": "../../a.bin",
    "a link that leads out": "out",
}


@pytest.mark.parametrize("name", ODD_PATHS)
@pytest.mark.parametrize("mesh", ["m/a.obj", "m/a.gltf", "m/a.glb"])
def test_paths_that_lead_nowhere_are_refused(tmp_path, name, mesh):
    path = ODD_PATHS[name]
    header = json.dumps(gltf_header(path))
    content = {"obj": OBJ.replace("a.mtl", path), "gltf": header, "glb": glb(header, b"")}[mesh.split(".")[1]]
    folder = make_set(tmp_path / "set", mesh, content)
    (folder / "m/circle").symlink_to("circle")
    (folder / "m/out").symlink_to("/etc/passwd")
    with pytest.raises(InputError) as caught:
        companions(folder)
    assert caught.value.key == "meshes.a.file" and caught.value.cure and len(caught.value.found) < 300


HEADERS = {
    "null buffers": {"buffers": None},
    "uri of 5": {"buffers": [{"byteLength": 5, "uri": 5}]},
    "buffers of numbers": {"buffers": [1]},
    "web address": {"buffers": [{"byteLength": 5, "uri": "https://x/y.bin"}]},
    "folder": {"buffers": [{"byteLength": 5, "uri": "."}]},
    "pipe": {"buffers": [{"byteLength": 5, "uri": "pipe"}]},
    "not there": {"buffers": [{"byteLength": 5, "uri": "gone.bin"}]},
    "too large": {"buffers": [{"byteLength": 5, "uri": "sparse"}]},
    "draco": {"extensionsRequired": ["KHR_draco_mesh_compression"]},
}


@pytest.mark.parametrize("name", HEADERS)
@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_odd_gltf_headers_are_refused(tmp_path, name, kind):
    header = json.dumps(json.loads(gltf_text()) | HEADERS[name])
    folder = make_set(tmp_path / "set", f"a.{kind}", header if kind == "gltf" else glb(header))
    os.mkfifo(folder / "pipe")
    with open(folder / "sparse", "wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(InputError) as caught:
        companions(folder)
    assert caught.value.key == "meshes.a.file" and caught.value.cure


@pytest.mark.parametrize("text", ["", "[", "[]", '{"extras": ' + "[" * 100_000, '{"a": ' * 100_000, "\xff", "null"])
@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_what_is_no_json_is_refused(tmp_path, text, kind):
    with pytest.raises(InputError):
        companions(make_set(tmp_path / "set", f"a.{kind}", text.encode("latin-1") if kind == "gltf" else glb(text or " ")))


def test_legal_buffers_are_companions(tmp_path):
    for uri, name in (("box%201.bin", "m/box 1.bin"), ("../buffers/b.bin", "m/../buffers/b.bin"), ("a/../b.bin", "m/a/../b.bin")):
        for mesh in ("m/a.gltf", "m/a.glb"):
            header = json.dumps(gltf_header(uri))
            folder = make_set(tmp_path / "set", mesh, header if mesh.endswith("gltf") else glb(header, b""))
            for file in ("m/box 1.bin", "buffers/b.bin", "m/b.bin", "m/a/x"):
                write(folder, file, DATA)
            assert companions(folder) == [name]
            assert name in dataset_slice(read_dataset(folder), "objects").files


def test_textures_and_a_pipe_for_an_mtl_are_left_alone(tmp_path):
    folder = make_set(tmp_path / "set", "a.obj", OBJ)
    os.mkfifo(folder / "a.mtl")
    assert companions(folder) == []
    (folder / "a.mtl").unlink()
    write(folder, "a.mtl", "newmtl red\nmap_Kd pipe.png\nmap_Ks /dev/zero\n")
    assert companions(folder) == ["a.mtl"]
    textured = json.loads(gltf_text()) | {"images": [{"uri": "../../../dev/zero"}, {"uri": "pipe.png"}]}
    assert companions(make_set(tmp_path / "other", "a.gltf", json.dumps(textured))) == []


def test_a_mesh_and_its_companions_that_another_user_may_not_read(open_folder, as_other_user):
    folder = make_set(open_folder / "set", "a.gltf", json.dumps(gltf_header("b.bin")))
    write(folder, "b.bin", DATA)
    for name in ("a.gltf", "b.bin"):
        (folder / name).chmod(0)
        with as_other_user(), pytest.raises(InputError, match="Permission denied"):
            companions(folder)
        (folder / name).chmod(0o644)
