"""One graph, written for three runners: the same photos, the same bytes, the same functions.

    photo, mask ─► develop ─► pose ─► sample ─► total      three steps a photo, and one over all photos

A step's output is a hash of its inputs, stretched to a size: what is measured is the runner, not the work.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

SIDE = 148  # pixels of a photo's side: noise of three channels is a PNG of about 66 kB
SIZES = {"develop": 16_384, "pose": 512, "sample": 8_192, "total": 1_024}  # bytes of a step's output
TAKES = {"develop": (), "pose": ("develop",), "sample": ("develop", "pose")}  # of the same photo

WORK = '''"""What every step does: its inputs hashed, and the hash stretched to a size."""

import hashlib
import sys
from pathlib import Path


def made(size, paths):
    """`size` bytes that follow from the contents of the files."""
    return hashlib.shake_256(b"".join(Path(path).read_bytes() for path in paths)).digest(size)


if __name__ == "__main__":
    Path(sys.argv[2]).write_bytes(made(int(sys.argv[1]), sys.argv[3:]))
'''


def names(photos: int) -> list[str]:
    """Of the photos."""
    return [f"photo_{k:05d}" for k in range(photos)]


def write_photos(folder: Path, photos: int) -> None:
    """photos/<name>.png and masks/<name>.png: noise, the same in every run."""
    rng = np.random.default_rng(0)
    for kind in ("photos", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for name in names(photos):
        Image.fromarray(rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)).save(folder / "photos" / f"{name}.png", compress_level=1)
        Image.fromarray(rng.integers(0, 2, (SIDE, SIDE), dtype=np.uint8)).save(folder / "masks" / f"{name}.png", compress_level=1)


def inputs_of(step: str, name: str, out: str = "out") -> list[str]:
    """The files that a step of a photo reads, from the project's folder."""
    files = [f"photos/{name}.png", f"masks/{name}.png"] if step == "develop" else []
    return files + [f"{out}/{above}/{name}.bin" for above in TAKES[step]]


# ── ours ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

STAGE = '''import msgspec

from work import made


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


def main(params, inputs, out, progress):
    {body}
'''
OF_PHOTO = '(out / f"{{inputs.photo}}.bin").write_bytes(made({size}, {files}))'
FILES = {
    "develop": '[inputs.file(inputs.facts["dataset.photo"]["image"]), inputs.file(inputs.facts["dataset.photo"]["masks"])]',
    "pose": '[inputs["develop"] / f"{inputs.photo}.bin"]',
    "sample": '[inputs[name] / f"{inputs.photo}.bin" for name in ("develop", "pose")]',
}
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"  # a data set must have one; no step reads it
PIPELINE = """format: 1
stages:
  develop: {inputs: [dataset.photo], over: photo, makes: ["{photo}.bin"]}
  pose: {inputs: [develop], over: photo, makes: ["{photo}.bin"]}
  sample: {inputs: [develop, pose], over: photo, makes: ["{photo}.bin"]}
  total: {inputs: [sample], makes: [total.bin]}
"""


def write_factorlib(folder: Path, photos: int) -> None:
    """A project of four stages, and the data set `set`."""
    data = folder / "data" / "set"
    for kind in ("photos", "masks"):
        shutil.copytree(folder / kind, data / kind)
        shutil.rmtree(folder / kind)
    (data / "ball.obj").write_text(MESH)
    entry = "  - {{name: {0}, image: photos/{0}.png, masks: masks/{0}.png, objects: [{{name: ball, mesh: ball}}]}}\n"
    entries = "".join(entry.format(name) for name in names(photos))
    meshes = "{ball: {file: ball.obj, material: paint}}"
    (data / "dataset.yaml").write_text(f"format: 1\nmaterials: [paint]\nmeshes: {meshes}\nphotos:\n{entries}")
    (folder / "stages").mkdir()
    (folder / "stages" / "__init__.py").write_text("")
    bodies = {step: OF_PHOTO.format(size=SIZES[step], files=files) for step, files in FILES.items()}
    bodies["total"] = f'(out / "total.bin").write_bytes(made({SIZES["total"]}, sorted(inputs["sample"].glob("*.bin"))))'
    for step, body in bodies.items():
        (folder / "stages" / f"{step}.py").write_text(STAGE.format(body=body))
    (folder / "pipeline.yaml").write_text(PIPELINE)


# ── DVC ──────────────────────────────────────────────────────────────────────────────────────────────────────────────


def write_dvc(folder: Path, photos: int) -> None:
    """dvc.yaml; and dvc.lock, which says that all is made: DVC writes it whole after every step, which takes it hours."""
    stages = {}
    for name in names(photos):
        for step in TAKES:
            stages[f"{step}-{name}"] = _dvc_stage(folder, f"out/{step}/{name}.bin", SIZES[step], inputs_of(step, name))
    stages["total"] = _dvc_stage(folder, "out/total.bin", SIZES["total"], [f"out/sample/{name}.bin" for name in names(photos)])
    # JSON is YAML, and DVC reads it faster
    plain = {name: {"cmd": s["cmd"], "deps": [d["path"] for d in s["deps"]], "outs": [{s["outs"][0]["path"]: {"cache": False}}]} for name, s in stages.items()}
    (folder / "dvc.yaml").write_text(json.dumps({"stages": plain}, indent=1))
    (folder / "dvc.lock").write_text(json.dumps({"schema": "2.0", "stages": stages}, indent=1))


def _dvc_stage(folder: Path, out: str, size: int, files: list[str]) -> dict:
    deps = [_dvc_file(folder, file) for file in sorted(["work.py", *files])]
    return {"cmd": f"python work.py {size} {out} {' '.join(files)}", "deps": deps, "outs": [_dvc_file(folder, out)]}


def _dvc_file(folder: Path, file: str) -> dict:
    data = (folder / file).read_bytes()
    return {"path": file, "hash": "md5", "md5": hashlib.md5(data).hexdigest(), "size": len(data)}


# ── Snakemake ────────────────────────────────────────────────────────────────────────────────────────────────────────

SNAKEFILE = '''NAMES = [f"photo_{{k:05d}}" for k in range({photos})]

rule total:
    input: expand("out/sample/{{name}}.bin", name=NAMES)
    output: "out/total.bin"
    shell: "python work.py {total} {{output}} {{input}}"

rule develop:
    input: "photos/{{name}}.png", "masks/{{name}}.png"
    output: "out/develop/{{name}}.bin"
    shell: "python work.py {develop} {{output}} {{input}}"

rule pose:
    input: "out/develop/{{name}}.bin"
    output: "out/pose/{{name}}.bin"
    shell: "python work.py {pose} {{output}} {{input}}"

rule sample:
    input: "out/develop/{{name}}.bin", "out/pose/{{name}}.bin"
    output: "out/sample/{{name}}.bin"
    shell: "python work.py {sample} {{output}} {{input}}"
'''


def write_snakemake(folder: Path, photos: int) -> None:
    """A Snakefile of four rules."""
    (folder / "Snakefile").write_text(SNAKEFILE.format(photos=photos, **SIZES))


WRITERS: dict[str, Callable[[Path, int], None]] = {"factorlib": write_factorlib, "dvc": write_dvc, "snakemake": write_snakemake}


def make_outputs(folder: Path, photos: int, size_of: dict[str, int] = SIZES) -> None:
    """Every output, made without a runner."""
    made: Callable = _work(folder)
    for step in TAKES:
        (folder / "out" / step).mkdir(parents=True, exist_ok=True)
        for name in names(photos):
            (folder / "out" / step / f"{name}.bin").write_bytes(made(size_of[step], [folder / file for file in inputs_of(step, name)]))
    samples = [folder / "out" / "sample" / f"{name}.bin" for name in names(photos)]
    (folder / "out" / "total.bin").write_bytes(made(size_of["total"], samples))


def _work(folder: Path) -> Callable:
    space: dict = {"__name__": "work"}
    exec((folder / "work.py").read_text(), space)
    return space["made"]
