"""Packing of a result into one portable file, with all that readers and `factorlib.load_result` need.

The data set itself is not included.
"""

import os
import zipfile
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from factorlib.errors import InputError
from factorlib.wholefile import writing

NEEDED = ("report", "export", "masks", "align")
STAGES = (*NEEDED, "evaluate", "exchange", "recipes", "render", "shapes", "solve", "surface", "texture")
READ_ME = """\
report/index.html              everything on one page: open this first
export/materials.json          diffuse and specular reflectance (linear Rec. 709), roughness r (GGX with \
alpha = r * r), standard errors
export/illumination/*.exr      environment maps, lat-long, linear radiance in the units of their photos: top row +y, \
centre +z toward the
                               viewer, +x a quarter of the width from the left edge
export/*.glb, *.mtlx, scenes/  meshes, materials and scenes for other programs; the camera's frame of scenes is \
x right, y up, z toward the viewer
export/meshes/*.ply            meshes in their own frames; align/poses.json: cam_from_object, OpenCV \
(x right, y down, z forward), lengths as in the meshes
render/resynthesis/*.exr       photographs rendered again, linear
recipes/                       pictures that were asked for
evaluate/metrics.json          errors, and how far to trust the result

In Python: factorlib.load_result("<this folder>")
"""


def write_pack(home: Path, out: Path, replace: bool = False) -> int:
    """Write a result into a zip file, in a folder of the data set's name, and return the number of files.

    Args:
        home: the result folder build/<dataset>
        out: the zip file
        replace: replace an existing file

    Raises:
        InputError: A needed stage has no result, `out` is not the name of a zip file, or it exists already.
    """
    check_whole(home, (*NEEDED, "export/dataset.json"))
    faults = {
        "is a folder, not a zip file": out.is_dir(),
        "its name does not end in .zip": out.suffix != ".zip",
        "the folder that it would be in does not exist": not out.absolute().parent.is_dir(),
    }
    if fault := next((fault for fault, applies in faults.items() if applies), None):
        raise InputError(fault, file=out, key="OUT", cure="write OUT=<name>.zip, in an existing folder")
    if out.exists() and not replace:
        raise InputError(
            "the file exists already", file=out, key="OUT", cure="name another file, or add FORCE=1 to replace it"
        )
    walks = (os.walk(home / stage, followlinks=True) for stage in STAGES)  # links into the store
    below = [sorted(Path(place) / name for place, _, names in walk for name in names) for walk in walks]
    files = [home / "dataset.txt", *chain.from_iterable(below)]
    entries = {f"{home.name}/{path.relative_to(home).as_posix()}": path for path in files}
    draft = out.with_name(f".{out.name}.{os.getpid()}")
    with writing(draft):
        with zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(_entry(f"{home.name}/READ_ME.txt"), READ_ME)
            for name, path in sorted(entries.items()):
                archive.writestr(_entry(name), path.read_bytes())
        os.replace(draft, out)
    return len(entries) + 1


def check_whole(home: Path, needed: Iterable[str]) -> None:
    """Raise InputError if a folder of results lacks one of the needed files or folders."""
    if missing := [path for path in needed if not (home / path).exists()]:
        mark = home / "dataset.txt"  # names the data set of a copy, which may have another name
        dataset = mark.read_text(encoding="utf-8", errors="replace").strip() if mark.is_file() else home.name
        cure = f"make all DATASET={Path(dataset).name}"
        raise InputError(f"the result is incomplete: {missing[0]} is missing", file=home, cure=cure)


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)  # It has a fixed date, so that equal results are equal files.
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    return entry
