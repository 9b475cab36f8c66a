"""Every writer says so where a file finds no room, and leaves no cut one.

Room ends by a limit on the size of files, which needs no right: the system then says so as on a full disk.
"""

import ast
import contextlib
import resource
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.disk import disk_error
from factorlib.errors import InputError
from factorlib.export.gltf import write_glb
from factorlib.export.usd import write_usd_mesh
from factorlib.generate.folder import write_codes, write_obj, write_yaml
from factorlib.images.exr import LAT_LONG, write_exr, write_rgb_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.light.lobes import Lobes
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import write_ply
from factorlib.parquetfile import write_rows
from factorlib.reflection.network import Layers, write_layers
from factorlib.reflection.training import Step
from factorlib.results.lobes import write_lobes
from factorlib.results.materials import Reflectance
from factorlib.runner.project import LIBRARY
from factorlib.solve.history import Event
from factorlib.urm.observations import write_observations
from factorlib.wholefile import append_text, bytes_of, replace_file, write_text
from stages.train import _write_curves
from tests.faults import good

RNG = np.random.default_rng
PIXELS = RNG(0).random((48, 64, 3), dtype=np.float32)
CODES = (255 * PIXELS).astype(np.uint8)
GLOSS = {name: Reflectance((0.1, 0.2, 0.3), (0.1, 0.1, 0.1), 0.5) for name in ("red", "wood")}
UNIT = RNG(0).normal(size=(300, 3))
UNIT /= np.linalg.norm(UNIT, axis=1, keepdims=True)
LABELS = RNG(0).integers(1, 3, 400).astype(np.int16)
MESH = Mesh(UNIT, RNG(0).integers(0, 300, (400, 3)).astype(np.int32), UNIT, LABELS)
LAYERS = Layers(torch.zeros(8), torch.ones(8), [torch.ones(32, 8), torch.ones(1, 32)], [torch.ones(32), torch.ones(1)])


WRITERS = {
    "masks and align: EXR of many channels": ("a.exr", lambda path: write_exr(path,
    {f"n.{k}": PIXELS[..., 0] for k in range(7)})),
    "export and render: EXR of a light": ("a.exr", lambda path: write_rgb_exr(path, PIXELS, LAT_LONG)),
    "align and render: PNG": ("a.png", lambda path: write_png(path, CODES)),
    "every stage: JSON": ("a.json", lambda path: write_json(path, {"a": PIXELS.tolist()})),
    "urm: observations": ("a.parquet", lambda path: write_observations(path, good.observations(2000))),
    "solve: lobes": ("a.parquet", lambda path: write_lobes(path,
    {"a": Lobes(RNG(0).random((200, 3)), RNG(0).random(200), RNG(0).random((200, 3)))})),
    "solve: convergence": ("a.parquet", lambda path: write_rows(path, Event,
    [Event(k, "a", k, k / 7, k / 3, k) for k in range(500)])),
    "train: curves": ("a.parquet", lambda path: _write_curves(path,
    {"a": [Step(k, k / 3, k / 7, k / 9, k / 11) for k in range(300)]})),
    "train: weights": ("a.safetensors", lambda path: write_layers(path, LAYERS)),
    "train and solve: what they go on from": ("a.pt", lambda path: Checkpoint(path).save({"a": torch.arange(3000.0)})),
    "export: PLY": ("a.ply", lambda path: write_ply(path, MESH)),
    "export: glTF": ("a.glb", lambda path: write_glb(path, MESH, ["red", "wood"], GLOSS)),
    "export: USD": ("a.usda", lambda path: write_usd_mesh(path, MESH)),
    "export and report: text": ("a.html", lambda path: write_text(path, "a page " * 500)),
    "generate: JPEG": ("a.jpg", lambda path: write_codes(path, CODES, {"Compression": "jpeg:95"})),
    "generate: 16 bits": ("a.png", lambda path: write_codes(path, CODES.astype(np.uint16) * 257, {})),
    "generate: OBJ": ("a.obj", lambda path: write_obj(path, {"a": (RNG(0).random((300, 3)),
    RNG(0).integers(0, 300, (200, 3)))})),
    "generate: YAML": ("a.yaml", lambda path: write_yaml(path, {"a": list(range(2000))}, "numbers")),
    "runner: keys and logs": ("a.json", lambda path: replace_file(path, b"{}" * 2000)),
}  # fmt: skip


@contextlib.contextmanager
def largest_file(size: int):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def unlimited(write):
    with largest_file(resource.RLIM_INFINITY):
        return bytes_of(write)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_that_finds_no_room_is_an_error_and_is_not_there(tmp_path, monkeypatch, kind):
    name, write = WRITERS[kind]
    if name.endswith(
        ".jpg"
    ):  # libjpeg ends the process where it finds no room, so it must never write to a disk itself
        monkeypatch.setattr("factorlib.images.write.bytes_of", unlimited)
    path = tmp_path / name
    write(path)
    size = path.stat().st_size
    for room in (size - 1, size - 100, size // 2, 1):
        path.unlink()
        with largest_file(room), pytest.raises(Exception) as caught:
            write(path)
        assert not list(tmp_path.iterdir()), "a cut file is left behind"
        known = disk_error(caught.value, tmp_path)
        assert isinstance(known, InputError) and known.file == tmp_path and "MB are free" in known.found, caught.value
        write(path)
        assert path.stat().st_size == size


@pytest.mark.parametrize("kind", ["runner: keys and logs", "train and solve: what they go on from"])
def test_what_is_replaced_stays_whole_where_the_new_finds_no_room(tmp_path, kind):
    name, write = WRITERS[kind]
    path = tmp_path / name
    path.write_bytes(b"old")
    with largest_file(1000), pytest.raises(OSError):
        write(path)
    assert path.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == [name]


def test_no_part_of_a_line_is_left_at_the_end_of_a_log(tmp_path):
    path = tmp_path / "log.jsonl"
    append_text(path, '{"event": "done"}\n')
    with largest_file(25), pytest.raises(OSError):
        append_text(path, '{"event": "failed"}\n')
    assert path.read_text() == '{"event": "done"}\n'


def test_an_image_goes_through_memory_to_the_bytes_that_openimageio_itself_writes(tmp_path):
    spec = oiio.ImageSpec(64, 48, 3, oiio.FLOAT)
    for name, value in {"compression": "zip", "DateTime": "2000:01:01 00:00:00", "Software": "factorlib"}.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(tmp_path / "direct.exr"))
    assert output.open(str(tmp_path / "direct.exr"), spec) and output.write_image(PIXELS) and output.close()
    del output
    write_rgb_exr(tmp_path / "memory.exr", PIXELS)
    assert (tmp_path / "direct.exr").read_bytes() == (tmp_path / "memory.exr").read_bytes()


# methods that write to a path, and who may: the writers themselves, what is no result, and words of progress
WRITING = {"write_text", "write_bytes", "save_file", "savefig", "imwrite", "tofile", "savez", "save_image"}
OWN = ("wholefile.py", "images/write.py", "setup.py", "reflection/fused.py", "runner/worker.py")


def test_nothing_is_written_past_the_writers_that_check():
    files = {p for folder in ("factorlib", "stages", "studies") for p in (LIBRARY / folder).rglob("*.py")}
    files -= {LIBRARY / "factorlib" / name for name in OWN}
    files -= {LIBRARY / "studies/measured/scale.py"}  # the logs of processes that it starts
    assert not [f"{p.relative_to(LIBRARY)}:{node.lineno}" for p in files for node in _calls(p) if _writes_past(node)]


def _calls(path: Path) -> list[ast.Call]:
    """Calls that are not inside `with writing(…)`."""
    tree = ast.parse(path.read_text())
    inside = {
        id(n)
        for w in ast.walk(tree)
        if isinstance(w, ast.With) and "writing(" in ast.unparse(w.items[0])
        for n in ast.walk(w)
    }
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call) and id(node) not in inside]


def _writes_past(call: ast.Call) -> bool:
    text = ast.unparse(call.func)
    if text.endswith((".write_table", "ImageOutput.create", "torch.save")):
        return "stream" not in ast.unparse(call)
    if text in ("open", "os.fdopen"):
        modes = [
            a.value
            for a in [*call.args[1:], *(k.value for k in call.keywords if k.arg == "mode")]
            if isinstance(a, ast.Constant)
        ]
        return (
            any(isinstance(m, str) and set(m) & set("wax+") for m in modes)
            and "/proc/" not in ast.unparse(call)
            and "events" not in ast.unparse(call)
        )
    return isinstance(call.func, ast.Attribute) and call.func.attr in WRITING
