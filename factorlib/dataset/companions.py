"""The files a mesh file draws in: an OBJ's .mtl, a glTF's buffers.

They belong to a mesh's content: when one changes, so does the mesh.
"""

from __future__ import annotations

import json
import mmap
import re
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from factorlib.dataset.check import Refusal

_MTLLIB = re.compile(rb"^mtllib[ \t]+([^\r\n]+)", re.MULTILINE)


def companions_of_mesh(path: str, key: str, refuse: Refusal) -> list[str]:
    """Dataset-relative paths of the companions of the mesh at dataset-relative `path`.

    An absent .mtl is left out, for a part's name is in the OBJ itself; an absent glTF buffer is refused, and so is
    any companion outside the dataset.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".obj":
        return [near for near in _beside(path, _mtllibs(refuse.folder / path), key, refuse) if (refuse.folder / near).is_file()]
    if suffix == ".gltf":
        return _present(_beside(path, _buffers(refuse.folder / path, key, refuse), key, refuse), key, refuse)
    return []


def _mtllibs(file: Path) -> list[str]:
    if file.stat().st_size == 0:
        return []
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if text.find(b"mtllib") < 0:
            return []
        return [match.group(1).decode("utf-8", "replace").strip() for match in _MTLLIB.finditer(text)]


def _buffers(file: Path, key: str, refuse: Refusal) -> list[str]:
    try:
        uris = [buffer.get("uri", "") for buffer in json.loads(file.read_text(encoding="utf-8")).get("buffers", [])]
    except (ValueError, AttributeError) as error:
        refuse(key, f"{file.name} is not readable as glTF ({error})", "export it again, as .glb or .gltf")
    return [unquote(uri) for uri in uris if uri and not uri.startswith("data:")]


def _beside(path: str, named: list[str], key: str, refuse: Refusal) -> list[str]:
    near = sorted({str(PurePosixPath(path).parent / name.replace("\\", "/")) for name in named})
    for companion in near:
        if not (refuse.folder / companion).resolve().is_relative_to(refuse.folder.resolve()):
            refuse(key, f"{Path(path).name} names {companion!r}, which is outside the dataset", "copy that file beside the mesh")
    return near


def _present(paths: list[str], key: str, refuse: Refusal) -> list[str]:
    for path in paths:
        if not (refuse.folder / path).is_file():
            refuse(key, f"the mesh names {path!r}, which is not there", "copy it beside the mesh, or export one .glb")
    return paths
