"""The header of a glTF file: its buffers, meshes and nodes.  No buffer is opened here.

Only the fields that geometry needs are decoded; textures, animations and the like are skipped.  Field names are glTF
2.0's.  A file that requires an extension which may change geometry, and is not read, is refused by the extension's
name.
"""

import re
import struct
from codecs import BOM_UTF8
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal
from urllib.parse import unquote

import msgspec

from factorlib.errors import InputError
from factorlib.reading import MOST_BYTES, check_plain, one_line, reading

Count = Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]
Numbers3 = tuple[float, float, float]
WHAT = "glTF"
CURE = "the file may be incomplete: export it again, as .glb or .gltf"
MOST_VALUES = 2_000_000  # values in a header: each becomes an object of some hundred bytes; base64 has no commas
BEFORE_JSON = 20  # bytes of a .glb before its JSON: its own header, and that of its first chunk
HARMLESS = re.compile(  # extensions that are read, and those of materials, textures, lights and animations
    r"EXT_mesh_gpu_instancing|KHR_(mesh_quantization|animation_pointer|xmp_json_ld)|[A-Z]+_(materials|texture|lights)_\w+"
)
SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")


class Buffer(msgspec.Struct, frozen=True):
    """A buffer: a file or `data:…`, or the chunk of a .glb if there is no uri."""

    byteLength: Count
    uri: str | None = None


class BufferView(msgspec.Struct, frozen=True):
    """A range of a buffer; `byteStride` is the distance of its elements, None if they are adjacent."""

    buffer: Count
    byteLength: Count
    byteOffset: Count = 0
    byteStride: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None


class Accessor(msgspec.Struct, frozen=True):
    """An array of `count` elements; `normalized`: integers stand for fractions; `sparse`: the elements that differ.

    `componentType` is signed or unsigned byte, signed or unsigned short, unsigned int or float, in this order.
    """

    count: Count
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Count | None = None
    byteOffset: Count = 0
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
    """A mesh of primitives, and default weights of its morph targets."""

    primitives: list[Primitive]
    name: str | None = None
    weights: list[float] = []


class GltfMaterial(msgspec.Struct, frozen=True):
    """A material, whose name `parts` in dataset.yaml may use."""

    name: str | None = None


class GltfNode(msgspec.Struct, frozen=True):
    """A node of the scene graph: a mesh and its transform to the parent.

    The transform is a matrix (by columns), or translation, rotation (quaternion x y z w) and scale. A skin replaces the
    transform, `weights` replace those of the mesh.
    """

    mesh: Count | None = None
    name: str | None = None
    children: list[Count] = []
    matrix: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: Numbers3 = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: Numbers3 = (1.0, 1.0, 1.0)
    skin: Count | None = None
    weights: list[float] = []
    extensions: dict[str, dict] = {}


class GltfScene(msgspec.Struct, frozen=True):
    """The root nodes of a scene."""

    nodes: list[Count] = []


class Versioned(msgspec.Struct, frozen=True):
    """The JSON of any version of glTF."""

    asset: dict[str, Any]


class GltfHeader(msgspec.Struct, frozen=True):
    """The JSON of a glTF file, as far as it names parts and places them.

    Attributes:
        scene: index of the scene to read, None for the first
    """

    buffers: list[Buffer] = []
    bufferViews: list[BufferView] = []
    accessors: list[Accessor] = []
    materials: list[GltfMaterial] = []
    meshes: list[GltfMesh] = []
    nodes: list[GltfNode] = []
    scenes: list[GltfScene] = []
    scene: Count | None = None
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []

    def entry(self, kind: str, index: int) -> Any:
        """Return entry `index` of the list `kind`; ValueError if it has no such entry."""
        if not 0 <= index < len(getattr(self, kind)):
            raise ValueError(f"it refers to {kind}[{index}], but has {len(getattr(self, kind))} {kind}")
        return getattr(self, kind)[index]


def unread(extensions: list[str]) -> str:
    """Join the names of those extensions that may change geometry and are not read.

    >>> unread(["KHR_materials_ior", "KHR_mesh_quantization", "MSFT_lod", "KHR_texture_transform", "ACME_materials"])
    'MSFT_lod, ACME_materials'
    """
    return one_line(", ".join(name for name in extensions if not HARMLESS.fullmatch(name)))


def read_header(file: Path, key: str | None = None, most_bytes: int = MOST_BYTES) -> GltfHeader:
    """Read the header of a .gltf or .glb.

    Args:
        file: the file
        key: the key in dataset.yaml, for errors
        most_bytes: largest size of the file

    Raises:
        InputError: The file is not glTF 2.0, or requires an extension that is not read.
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
        text = stream.read(size if length is None else length).removeprefix(BOM_UTF8).rstrip(b" \0")
        if text.count(b",") > MOST_VALUES:
            raise refusal(
                f"its header has more than {MOST_VALUES:,} values",
                "export the geometry alone, with its data in a .bin file or as .glb",
            )
        version = msgspec.json.decode(text, type=Versioned).asset["version"]
        if version.split(".")[0] != "2":
            raise refusal(f"is glTF {one_line(version[:20])}", "export it again, as glTF 2.0")
        header = msgspec.json.decode(text, type=GltfHeader)
    if names := unread(header.extensionsRequired):
        raise refusal(f"requires {names}, which is not read", f"export it again without {names}")
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
