"""`make validate` looks at every file's header with the checks of the stages, and `make all` does so for what is new, before it runs anything."""

from __future__ import annotations

import json
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from faults.mesh_files import DATA, OBJ, gltf_header
from PIL import Image
from runner import toy

from factorlib.dataset.check import MESHES
from factorlib.errors import InputError
from factorlib.images.exr import write_rgb_exr
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Data, Project, Provider, photo_sets

SIZE = (24, 18)  # width, height
TEN = 10


def label_mask(*labels: int) -> np.ndarray:
    mask = np.zeros(SIZE[::-1], np.uint8)
    for k, label in enumerate(labels):
        mask[4 + 4 * k : 7 + 4 * k, 4:16] = label
    return mask


def make_set(folder, photos: int = 2, size=SIZE):
    """A good data set: `photos` photos of a tetrahedron of two materials and of a glTF with its buffer in a folder beside it."""
    folder.mkdir(parents=True)
    entries = []
    for k in range(photos):
        Image.new("RGB", size, (90, 80, 70)).save(folder / f"p{k}.jpg")
        Image.fromarray(np.asarray(Image.fromarray(label_mask(1, 2)).resize(size, Image.NEAREST))).save(folder / f"p{k}.png")
        objects = [{"name": "a", "mesh": "solid"}, {"name": "b", "mesh": "box"}]
        entries.append({"name": f"p{k}", "image": f"p{k}.jpg", "masks": f"p{k}.png", "objects": objects})
    for name, content in (("meshes/a.obj", OBJ.encode()), ("buffers/b 1.bin", DATA), ("a.mtl", b"newmtl red\n"), ("meshes/b.gltf", None)):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content or json.dumps(gltf_header("../buffers/b%201.bin")).encode())
    meshes = {"solid": {"file": "meshes/a.obj", "parts": {"shell": "red"}}, "box": {"file": "meshes/b.gltf", "parts": {"chair": "oak"}}}
    spec = {"format": 1, "materials": ["red", "oak"], "meshes": meshes, "photos": entries}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec))
    return folder


@pytest.fixture
def folder(tmp_path):
    return make_set(tmp_path / "set")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """This project with a build/ of its own, in which nothing runs: what is known of the sources is kept."""
    root = tmp_path_factory.mktemp("project")
    for name in ("pipeline.yaml", "stages", "data"):
        (root / name).symlink_to(LIBRARY / name)
    return Project(root, photo_sets())


def rewrite(folder, **changes):
    file = folder / "dataset.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | changes))


def resize(folder):
    Image.fromarray(label_mask(1, 2)[:-1]).save(folder / "p1.png")


def unknown_label(folder):
    Image.fromarray(label_mask(1, 7)).save(folder / "p1.png")


def empty_mask(folder):
    Image.fromarray(label_mask()).save(folder / "p1.png")


def cut_mask(folder):
    (folder / "p1.png").write_bytes((folder / "p1.png").read_bytes()[:60])


def no_photo(folder):
    (folder / "p1.jpg").write_bytes(b"no photo")


def no_part(folder):
    rewrite(
        folder, meshes={"solid": {"file": "meshes/a.obj", "parts": {"shel": "red"}}, "box": {"file": "meshes/b.gltf", "material": "oak"}}
    )


def part_without_material(folder):
    (folder / "meshes/a.obj").write_text(OBJ.replace("g shell", "g shell2"))


def no_gltf_part(folder):
    rewrite(
        folder, meshes={"solid": {"file": "meshes/a.obj", "material": "red"}, "box": {"file": "meshes/b.gltf", "parts": {"shel": "oak"}}}
    )


def nan_vertex(folder):
    (folder / "meshes/a.obj").write_text(OBJ.replace("v 1.0", "v nan"))


def flat_mesh(folder):
    (folder / "meshes/a.obj").write_text("g shell\nv 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")


def cut_buffer(folder):
    (folder / "buffers/b 1.bin").write_bytes(DATA[:30])


def no_buffer(folder):
    (folder / "buffers/b 1.bin").unlink()


def pipe_for_a_buffer(folder):
    no_buffer(folder)
    os.mkfifo(folder / "buffers/b 1.bin")


FAULTS = {
    resize: "24 × 17 pixels, the photo 24 × 18",
    unknown_label: "unknown label 7",
    empty_mask: "the mask is empty",
    cut_mask: "p1.png",
    no_photo: "p1.jpg",
    no_part: "did you mean 'shell'",
    part_without_material: "part red / shell2 / chair has no material|no part 'shell'",
    no_gltf_part: "no part 'shel'",
    nan_vertex: "not finite",
    flat_mesh: "zero area",
    cut_buffer: "has 30 of 72 bytes",
    no_buffer: "b 1.bin",
    pipe_for_a_buffer: "is a pipe|not there",
}


def said_by(verb, capsys) -> tuple[int, str]:
    try:
        code = verb()
    except InputError as error:
        return 1, f"error: {error}"
    return code, capsys.readouterr().err


def test_a_good_set_is_said_to_be_good(project, folder, capsys):
    assert verbs.validate(project, str(folder), []) == 0
    assert "2 photos" in capsys.readouterr().out


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_each_fault_is_found_without_running_anything(project, folder, capsys, fault):
    fault(folder)
    for verb in (lambda: verbs.validate(project, str(folder), []), lambda: verbs.make(project, verbs.Wish(str(folder)))):
        code, said = said_by(verb, capsys)
        assert code == 1 and re.search(FAULTS[fault], said), said
    assert not list((project.root / "build").glob("set/*")), "something was run"


def test_all_faults_are_said_at_once_and_each_once(project, folder, capsys):
    for fault in (resize, nan_vertex, cut_buffer):
        fault(folder)
    code, said = said_by(lambda: verbs.validate(project, str(folder), []), capsys)
    assert code == 1 and said.count("error: ") == 3 and "3 faults" in said


def test_files_that_another_user_may_not_read(project, open_folder, capsys, as_other_user):
    folder = make_set(open_folder / "set")
    files = [path for path in folder.rglob("*") if path.suffix in (".jpg", ".png", ".obj", ".bin")]
    for path in files:
        path.chmod(0)
        with as_other_user():
            dataset = photo_sets().read
            with pytest.raises(InputError) as caught:
                data = dataset(folder)
                for fault in (f for slice_ in ("photo", "objects") for f in data.faults(slice_, None, {}, project.pipeline_file)):
                    raise fault
        assert path.name in str(caught.value), path
        path.chmod(0o644)


def test_the_limits_of_align_hold_for_validate(project, folder, capsys):
    code, said = said_by(lambda: verbs.validate(project, str(folder), ["align.limits.triangles=3"]), capsys)
    assert code == 1 and "4 triangles" in said
    assert verbs.validate(project, str(folder), ["align.limits.triangles=4"]) == 0
    code, said = said_by(lambda: verbs.validate(project, str(folder), ["align.limits.triangles=0"]), capsys)
    assert code == 1 and "SET align.limits.triangles=0: " in said


@pytest.mark.parametrize("size", [SIZE, (1024, 768)])
def test_ten_photos_take_less_than_a_second(tmp_path, size):
    data = photo_sets().read(make_set(tmp_path / "set", TEN, size))
    data.faults("truth", None, {}, tmp_path)  # imports science
    started = time.process_time()
    assert [fault for slice_ in ("photo", "objects") for fault in data.faults(slice_, None, {}, tmp_path)] == []
    assert time.process_time() - started < 1.0


# ---- the files that recipes name --------------------------------------------------------------------------------------


VERTICES = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OF_RECIPES = {
    "not_a_map.hdr": (b"no map", "not readable as an image"),
    "square.exr": (np.ones((8, 8, 3)), "no lat-long map.*\n.*twice its height"),
    "black.exr": (np.zeros((8, 16, 3)), "the map is black"),
    "holes.exr": (np.full((8, 16, 3), np.nan), "are no numbers"),
    "faceless.obj": (VERTICES, "mesh without faces"),
    "flat.obj": (VERTICES + b"f 1 1 2\n", "every face has zero area"),
    "cut.ply": (b"ply\nformat ascii 1.0\n", "has no header of a PLY"),
}


@pytest.mark.parametrize("name", OF_RECIPES)
def test_a_file_of_a_recipe_is_refused_before_anything_runs(project, folder, capsys, name):
    content, words = OF_RECIPES[name]
    write_rgb_exr(folder / name, content) if isinstance(content, np.ndarray) else (folder / name).write_bytes(content)
    wanted = f"mesh: {name}\nkind: insert" if Path(name).suffix in MESHES else f"lights: [{name}]\nkind: relight"
    (folder / "own.yaml").write_text(wanted)
    wish = verbs.Wish(str(folder), ["render"], recipes=[str(folder / "own.yaml")])
    code, said = said_by(lambda: verbs.make(project, wish), capsys)
    assert code == 1 and re.search(words, said, re.DOTALL) and str(folder / name) in said and "\n  " in said, said
    assert not list((project.root / "build").glob("set/*")), "something was run"


def test_good_files_of_recipes_have_no_faults(folder):
    write_rgb_exr(folder / "light.exr", np.ones((8, 16, 3)))
    files = {name: folder / name for name in ("light.exr", "meshes/a.obj", "meshes/b.gltf")}
    files["own.json"] = folder / "nothing_looks_at_tables.json"
    assert photo_sets().read(folder).recipe_faults(files) == []


# ---- what is looked at before a run -----------------------------------------------------------------------------------


def looked_at(root, **texts):
    """The toy project whose provider notes what it is asked to look at, and refuses a photo with the word 'fault'."""
    project = toy.make_project(root, **texts)
    asked = []

    def read(folder):
        data = toy.read(folder)

        def faults(slice_, photo, params, settings):
            asked.append((slice_, photo))
            return [InputError("a fault", file=f"{photo}.txt")] if "fault" in (folder / f"{photo}.txt").read_text() else []

        return Data(data.folder, data.photos, data.slice, faults)

    return Project(project.root, Provider(("photo",), read)), asked


def test_a_run_looks_at_what_is_new_and_no_more(tmp_path, capsys):
    project, asked = looked_at(tmp_path, a="Alpha", b="Beta")
    assert verbs.make(project, verbs.Wish("set")) == 0
    assert asked == [("photo", "a"), ("photo", "b")]
    asked.clear()
    assert verbs.make(project, verbs.Wish("set")) == 0
    assert verbs.make(project, verbs.Wish("set", settings=["upper.times=2"])) == 0
    assert asked == []
    toy.write(tmp_path / "data/set/c.txt", "a fault")
    assert verbs.make(project, verbs.Wish("set")) == 1
    assert asked == [("photo", "c")] and "a fault" in capsys.readouterr().err
