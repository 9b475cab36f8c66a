"""Every writer says so where a file finds no room, and leaves no cut one.

Room ends by a limit on the size of files, which needs no right: the system then says so as on a full disk.
"""

import ast
import contextlib
import errno
import re
import resource

import numpy as np
import pytest
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.errors import InputError
from factorlib.export.gltf_writer import write_glb
from factorlib.export.materialx import materialx
from factorlib.export.usd import write_usd_mesh
from factorlib.generate.folder import write_codes, write_obj, write_yaml
from factorlib.images.exr import LAT_LONG, write_exr, write_rgb_exr
from factorlib.images.picture import write_png
from factorlib.inference.fit_runner import Event
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import write_ply
from factorlib.parquetfile import write_rows
from factorlib.reflection.network import Layers, write_layers
from factorlib.results.materials import Reflectance
from factorlib.runner.project import LIBRARY
from factorlib.urm.observations import write_observations
from factorlib.wholefile import bytes_of, disk_error, replace_file, write_text
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


WRITERS = {  # file -> who writes it; what stands after a blank tells those of one kind apart
    "a.exr": lambda path: write_exr(path, {f"n.{k}": PIXELS[..., 0] for k in range(7)}),
    "a.exr of light": lambda path: write_rgb_exr(path, PIXELS, LAT_LONG),
    "a.png": lambda path: write_png(path, CODES),
    "a.png of 16 bits": lambda path: write_codes(path, CODES.astype(np.uint16) * 257, {}),
    "a.jpg": lambda path: write_codes(path, CODES, {"Compression": "jpeg:95"}),
    "a.json": lambda path: write_json(path, {"a": PIXELS.tolist()}),
    "a.json of the runner": lambda path: replace_file(path, b"{}" * 2000),
    "a.parquet": lambda path: write_observations(path, good.observations(2000)),
    "a.parquet of rows": lambda path: write_rows(path, Event, [Event(k, "a", k, k / 7, k / 3, k) for k in range(500)]),
    "a.safetensors": lambda path: write_layers(path, LAYERS),
    "a.pt": lambda path: Checkpoint(path).save({"a": torch.arange(3000.0)}),
    "a.ply": lambda path: write_ply(path, MESH), "a.glb": lambda path: write_glb(path, MESH, ["red", "wood"], GLOSS),
    "a.mtlx": lambda path: write_text(path, materialx(GLOSS)), "a.usda": lambda path: write_usd_mesh(path, MESH),
    "a.obj": lambda path: write_obj(path, {"a": (MESH.vertices, MESH.faces)}),
    "a.yaml": lambda path: write_yaml(path, {"a": list(range(2000))}, "numbers"),
    "a.html": lambda path: write_text(path, "a page " * 500),
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
def test_a_file_that_finds_no_room_is_an_error_is_not_there_and_leaves_whole_what_it_would_replace(
    tmp_path, monkeypatch, kind
):
    path, write = tmp_path / kind.partition(" ")[0], WRITERS[kind]
    if (
        path.suffix == ".jpg"
    ):  # libjpeg ends the process where it finds no room, so it must never write to a disk itself
        monkeypatch.setattr("factorlib.images.exr.bytes_of", unlimited)
    write(path)
    size = path.stat().st_size
    for room in (size - 1, size // 2, 1):
        path.unlink()
        with largest_file(room), pytest.raises(Exception) as caught:
            write(path)
        assert not list(tmp_path.iterdir()), "a cut file is left behind"
        known = disk_error(caught.value, tmp_path)
        assert isinstance(known, InputError) and known.file == tmp_path and "MB are free" in known.found, caught.value
        write(path)
        assert path.stat().st_size == size
    if kind in ("a.json of the runner", "a.pt"):
        path.write_bytes(b"old")
        with largest_file(size // 2), pytest.raises(OSError):
            write(path)
        assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_quota_and_a_full_disk_in_a_librarys_words_are_the_users_to_mend(tmp_path):
    said = RuntimeError("a library: I/O error: No space left on device (os error 28)")
    assert "the disk is full" in disk_error(said, tmp_path).found
    assert "quota is used up" in disk_error(OSError(errno.EDQUOT, "Disk quota exceeded"), tmp_path).found
    assert disk_error(RuntimeError("another"), tmp_path) is None


# calls that write to a path, and who may: the writers themselves, what is no result, and logs of processes
WRITING = r"\.(write_text|write_bytes|save_file|savefig|imwrite|tofile|savez|save_image)$"
STREAMS = r"(\.write_table|ImageOutput\.create|torch\.save)$"
OWN = ("wholefile.py", "images/exr.py", "setup.py", "reflection/fused.py", "runner/worker.py")


def test_nothing_is_written_past_the_writers_that_check():
    files = {p for folder in ("factorlib", "stages", "studies") for p in (LIBRARY / folder).rglob("*.py")}
    for path in files - {LIBRARY / "factorlib" / name for name in OWN}:
        tree = ast.parse(path.read_text())
        within = [w for w in ast.walk(tree) if isinstance(w, ast.With) and "writing(" in ast.unparse(w.items[0])]
        inside = {id(node) for with_ in within for node in ast.walk(with_)}
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and id(node) not in inside]
        assert not [f"{path}:{call.lineno}" for call in calls if _writes_past(call)]


def _writes_past(call: ast.Call) -> bool:
    name, text = ast.unparse(call.func), ast.unparse(call)
    if name in ("open", "os.fdopen"):
        return (
            bool(re.search(r"""['"](?=\w*[wax+])[rwaxbt+]+['"]""", text))
            and "/proc/" not in text
            and "events" not in text
        )
    return bool(re.search(WRITING, name) or (re.search(STREAMS, name) and "stream" not in text))
