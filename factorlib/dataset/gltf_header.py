"""The header of a glTF file: its buffers, meshes and nodes.  No buffer is opened here.

Only the fields that geometry needs are decoded; textures, animations and the like are skipped.  Field names are glTF
2.0's.
"""

import re
import struct
from pathlib import Path, PurePosixPath
from typing import Annotated
from urllib.parse import unquote

import msgspec

from factorlib.errors import InputError
from factorlib.reading import MOST_BYTES, check_plain, reading

Count = Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]
Numbers3 = tuple[float, float, float]
Numbers4 = tuple[float, float, float, float]
WHAT = "glTF"
CURE = "the file may be incomplete: export it again, as .glb or .gltf"
MOST_VALUES = 2_000_000  # values in a header: each becomes an object of some hundred bytes; base64 has no commas
BEFORE_JSON = 20  # bytes of a .glb before its JSON: its own header, and that of its first chunk
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")


class Asset(msgspec.Struct, frozen=True):
    """Version of glTF that a file has."""

    version: str


class Buffer(msgspec.Struct, frozen=True):
    """A buffer: a file or `data:…`, or the chunk of a .glb if there is no uri."""

    byteLength: Count
    uri: str | None = None


class Accessor(msgspec.Struct, frozen=True):
    """An array of `count` elements; `normalized`: integers stand for fractions; `sparse`: the elements that differ."""

    count: Count
    normalized: bool = False
    sparse: dict | None = None


class Primitive(msgspec.Struct, frozen=True):
    """Triangles of one material.

    Attributes:
        attributes: index of an accessor, by POSITION, NORMAL and so on
        indices: index of the accessor of the corners; None if positions are in order of corners
        material: index of the material
        mode: glTF's kind of primitive; 4 is triangles
    """

    attributes: dict[str, Count]
    indices: Count | None = None
    material: Count | None = None
    mode: int = 4  # triangles


class GltfMesh(msgspec.Struct, frozen=True):
    """A mesh of primitives."""

    primitives: list[Primitive]
    name: str | None = None


class GltfMaterial(msgspec.Struct, frozen=True):
    """A material, whose name `parts` in dataset.yaml may use."""

    name: str | None = None


class GltfNode(msgspec.Struct, frozen=True):
    """A node of the scene graph: a mesh and its transform to the parent.

    The transform is a matrix (by columns), or translation, rotation (quaternion x y z w) and scale.
    """

    mesh: Count | None = None
    name: str | None = None
    children: list[Count] = []
    matrix: tuple[float, ...] | None = None
    translation: Numbers3 = (0.0, 0.0, 0.0)
    rotation: Numbers4 = (0.0, 0.0, 0.0, 1.0)
    scale: Numbers3 = (1.0, 1.0, 1.0)


class GltfScene(msgspec.Struct, frozen=True):
    """The root nodes of a scene."""

    nodes: list[Count] = []


class GltfHeader(msgspec.Struct, frozen=True):
    """The JSON of a glTF file, as far as it names parts and places them.

    Attributes:
        scene: index of the scene to read, None for the first
    """

    asset: Asset
    buffers: list[Buffer] = []
    accessors: list[Accessor] = []
    materials: list[GltfMaterial] = []
    meshes: list[GltfMesh] = []
    nodes: list[GltfNode] = []
    scenes: list[GltfScene] = []
    scene: Count | None = None
    extensionsRequired: list[str] = []


def read_header(file: Path, key: str | None = None, most_bytes: int = MOST_BYTES) -> GltfHeader:
    """Read the header of a .gltf or .glb.

    Args:
        file: the file
        key: the key in dataset.yaml, for errors
        most_bytes: largest size of the file

    Raises:
        InputError: The file is not glTF 2.0, or its meshes are compressed.
    """

    def refusal(fault: str, cure: str) -> InputError:
        """Return an InputError about the file."""
        return InputError(fault, file=file, key=key, cure=cure)

    size = check_plain(file, WHAT, key, most_bytes)
    length = None
    with reading(WHAT, file, key, CURE), open(file, "rb") as stream:
        if file.suffix.lower() == ".glb":
            magic, version, _, length, kind = struct.unpack("<4sIII4s", stream.read(BEFORE_JSON))
            if magic != b"glTF" or version != 2 or kind != b"JSON":
                raise ValueError("it does not begin with the header of a .glb of version 2")
            if length > size - BEFORE_JSON:
                raise ValueError("its first chunk is longer than the file")
        text = stream.read(size if length is None else length)
        if text.count(b",") > MOST_VALUES:
            raise refusal(
                f"its header has more than {MOST_VALUES:,} values",
                "export the geometry alone, with its data in a .bin file or as .glb",
            )
        header = msgspec.json.decode(text, type=GltfHeader)
    if header.asset.version.split(".")[0] != "2":
        raise refusal(f"is glTF {header.asset.version[:20]}", "export it again, as glTF 2.0")
    for name in COMPRESSED:
        if name in header.extensionsRequired:
            raise refusal(f"its meshes are compressed ({name})", "export it without compression")
    return header


def buffer_path(uri: str) -> str | None:
    """Return the path of a buffer relative to the file that names it; None for an embedded one.

    Raises:
        ValueError: The address is not a file's.

    >>> buffer_path("../buffers/box%201.bin"), buffer_path("data:;base64,AAAA")
    ('../buffers/box 1.bin', None)
    """
    if uri.startswith("data:"):
        return None
    if SCHEME.match(uri):
        raise ValueError(f"refers to {uri[:80]!r}, which is not a local file")
    return str(PurePosixPath(unquote(uri).replace("\\", "/")))
