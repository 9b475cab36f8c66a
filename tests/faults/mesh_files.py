"""Small good meshes in every format that is read, for tests to spoil: a tetrahedron each."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

import numpy as np

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
OBJ = "mtllib a.mtl\no chair\ng shell\nusemtl red\n{}vn 0 0 1\n{}".format(
    "".join("v {} {} {}\n".format(*v) for v in VERTICES), "".join("f {} {}//1 {}\n".format(*(f + 1)) for f in FACES)
)
OFF = "OFF\n4 4 0\n{}{}".format("".join("{} {} {}\n".format(*v) for v in VERTICES), "".join("3 {} {} {}\n".format(*f) for f in FACES))
FACET = "facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n"
CORNERS = ["".join("vertex {} {} {}\n".format(*VERTICES[v]) for v in face) for face in FACES]
STL_TEXT = "solid chair\n{}endsolid chair\n".format("".join(FACET.format(corners) for corners in CORNERS))
STL = b"a" * 80 + struct.pack("<I", 4) + b"".join(struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES)
PLY_HEADER = """ply
format {} 1.0
comment TextureFile a.png
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
"""
PLY_TEXT = PLY_HEADER.format("ascii") + OFF.split("0\n", 1)[1]
PLY = (
    PLY_HEADER.format("binary_little_endian").encode()
    + VERTICES.astype("<f4").tobytes()
    + b"".join(b"\3" + f.astype("<i4").tobytes() for f in FACES)
)
DATA = VERTICES.astype("<f4").tobytes() + FACES.astype("<u2").tobytes()
MAGIC = 0x46546C67


def gltf_header(uri: str | None = None) -> dict:
    """The header of a glTF whose one buffer is DATA."""
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(DATA)} | ({"uri": uri} if uri is not None else {})],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "materials": [{"name": "red"}],
        "meshes": [{"name": "shell", "primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "nodes": [{"name": "chair", "mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }


def gltf_text(**changes) -> str:
    """A glTF with its buffer within."""
    return json.dumps(gltf_header("data:application/octet-stream;base64," + base64.b64encode(DATA).decode()) | changes)


def glb(header: dict | str | None = None, data: bytes = DATA) -> bytes:
    text = header if isinstance(header, str) else json.dumps(header or gltf_header())
    text = text.encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<III", MAGIC, 2, 12 + len(chunks)) + chunks


GOOD = {
    "text.obj": OBJ.encode(),
    "text.off": OFF.encode(),
    "text.stl": STL_TEXT.encode(),
    "binary.stl": STL,
    "text.ply": PLY_TEXT.encode(),
    "binary.ply": PLY,
    "whole.gltf": gltf_text().encode(),
    "whole.glb": glb(),
}


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path
