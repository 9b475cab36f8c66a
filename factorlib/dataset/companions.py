"""The files a mesh file draws in: an OBJ's .mtl, a glTF's buffers.  Textures are not needed, and not looked at.

They belong to a mesh's content: when one changes, so does the mesh.
"""

from __future__ import annotations

import mmap
import os
import re
from pathlib import Path, PurePosixPath

from factorlib.dataset.check import Refusal
from factorlib.dataset.gltf import buffer_path, read_header
from factorlib.reading import check_plain, path_inside, reading

_MTLLIB = re.compile(rb"^mtllib[ \t]+([^\r\n]+)", re.MULTILINE)


def companions_of_mesh(path: str, key: str, refuse: Refusal) -> list[str]:
    """Dataset-relative paths of the companions of the mesh at dataset-relative `path`.

    An absent .mtl is left out, for a part's name is in the OBJ itself, and so is one that is no plain file; an absent glTF
    buffer is refused, and so is any companion outside the dataset, or too large.
    """
    suffix, file = Path(path).suffix.lower(), refuse.folder / path
    if suffix == ".obj":
        near = [
            near for near in _beside(path, _mtllibs(file, key), key, refuse) if os.path.isfile(refuse.folder / near)
        ]
        return _plain(near, "an .mtl", key, refuse)
    if suffix in (".gltf", ".glb"):
        near = _beside(path, _buffers(file, key, refuse), key, refuse)
        return _plain(_present(near, key, refuse), "a glTF buffer", key, refuse)
    return []


def _mtllibs(file: Path, key: str) -> list[str]:
    if check_plain(file, "an OBJ", key) == 0:
        return []
    with (
        reading("an OBJ", file, key),
        file.open("rb") as stream,
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text,
    ):
        if text.find(b"mtllib") < 0:
            return []
        return [match.group(1).decode("utf-8", "replace").strip() for match in _MTLLIB.finditer(text)]


def _buffers(file: Path, key: str, refuse: Refusal) -> list[str]:
    header = read_header(file, key)
    try:
        named = [buffer_path(buffer.uri) for buffer in header.buffers if buffer.uri is not None]
    except ValueError as error:
        refuse(key, f"{file.name} {error}", "export it again, with its buffers beside it or as one .glb")
    return [path for path in named if path is not None]


def _beside(path: str, named: list[str], key: str, refuse: Refusal) -> list[str]:
    near = sorted({str(PurePosixPath(path).parent / name.replace("\\", "/")) for name in named})
    for companion in near:
        try:
            path_inside(refuse.folder, companion)
        except ValueError as error:
            fault = f"{Path(path).name} names {companion[:80]!r}, which {_within(error)}"
            refuse(key, fault, "copy that file beside the mesh")
    return near


def _within(error: ValueError) -> str:
    return "is outside the dataset" if "outside" in str(error) else str(error)


def _present(paths: list[str], key: str, refuse: Refusal) -> list[str]:
    for path in paths:
        try:
            os.stat(refuse.folder / path)
        except FileNotFoundError:
            refuse(key, f"the mesh names {path!r}, which is not there", "copy it beside the mesh, or export one .glb")
        except OSError:
            continue  # there, perhaps, and not to be opened: `_plain` says why
    return paths


def _plain(paths: list[str], what: str, key: str, refuse: Refusal) -> list[str]:
    for path in paths:
        check_plain(refuse.folder / path, what, key)
    return paths
