"""`make validate` finds every fault by the checks of the stages, and `make all` looks at what is new before it runs."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest

from factorlib.dataset.check import MESHES
from factorlib.errors import InputError
from factorlib.images.exr import write_rgb_exr
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Data, Project, Provider, photo_sets
from tests.faults.battered import make
from tests.faults.good import DATA, OBJ, make_set, put
from tests.runner import toy


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


def refusal(verb, capsys) -> str:
    """The words with which a verb is refused; nothing was run."""
    try:
        code, text = verb(), capsys.readouterr().err
    except InputError as error:
        code, text = 1, f"error: {error}"
    assert code == 1, text
    return text


FAULTS = {  # file -> what is in it, and words of the error
    "7.png": (b"no photo", "7.png"),
    "mask.png": (b"\x89PNG", "not readable as a PNG"),
    "m/chair.obj": (OBJ.replace("v 1.0", "v nan"), "not finite"),
    "buffers/b 1.bin": (DATA[:30], "has 30 of 72 bytes"),
}


def test_all_faults_are_said_at_once_and_each_once_without_running_anything(project, folder, capsys):
    assert verbs.validate(project, str(folder), []) == 0 and "2 photos" in capsys.readouterr().out
    for name, (content, _) in FAULTS.items():
        put(folder / name, content)
    for verb in (
        lambda: verbs.validate(project, str(folder), []),
        lambda: verbs.make(project, verbs.Wish(str(folder))),
    ):
        text = refusal(verb, capsys)
        assert all(words in text for _, words in FAULTS.values())
        assert text.count("error: ") == 4 and "4 faults" in text
    assert not list((project.root / "build").glob("set/*")), "something was run"


def test_the_limits_of_align_hold_for_validate(project, folder, capsys):
    look = lambda most: verbs.validate(project, str(folder), [f"align.limits.triangles={most}"])  # noqa: E731
    assert "4 triangles" in refusal(lambda: look(3), capsys)
    assert look(4) == 0
    assert "SET align.limits.triangles=0: " in refusal(lambda: look(0), capsys)


def test_looking_at_a_set_takes_less_than_a_second(folder):
    data = photo_sets().read(folder)
    data.faults("truth", None, {}, folder)  # imports science
    began = time.process_time()
    assert [fault for slice_ in ("photo", "objects") for fault in data.faults(slice_, None, {}, folder)] == []
    assert time.process_time() - began < 1.0


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
    write_rgb_exr(folder / name, content) if isinstance(content, np.ndarray) else put(folder / name, content)
    wanted = f"mesh: {name}\nkind: insert" if Path(name).suffix in MESHES else f"lights: [{name}]\nkind: relight"
    wish = verbs.Wish(str(folder), ["render"], recipes=[str(put(folder / "own.yaml", wanted))])
    text = refusal(lambda: verbs.make(project, wish), capsys)
    assert re.search(words, text, re.DOTALL) and str(folder / name) in text and "\n  " in text, text
    assert not list((project.root / "build").glob("set/*")), "something was run"


def test_good_files_of_recipes_have_no_faults(folder):
    files = {name: folder / name for name in ("light.exr", "m/chair.obj", "m/box.gltf")}
    assert photo_sets().read(folder).recipe_faults(files | {"own.json": folder / "nothing_looks_at_tables.json"}) == []


def test_a_run_looks_at_what_is_new_and_no_more(tmp_path, capsys):
    asked = []

    def read(folder):
        data = toy.read(folder)

        def faults(slice_, photo, params, settings):
            asked.append((slice_, photo))
            faulty = "fault" in (folder / f"{photo}.txt").read_text()
            return [InputError("a fault", file=f"{photo}.txt")] if faulty else []

        return Data(data.folder, data.photos, data.slice, faults)

    project = Project(toy.make_project(tmp_path).root, Provider(("photo",), read))
    assert make(project) == 0 and asked == [("photo", "a"), ("photo", "b")]
    asked.clear()
    assert make(project) == 0 and make(project, "upper.times=2") == 0 and asked == []
    toy.write(tmp_path / "data/set/c.txt", "a fault")
    assert make(project) == 1
    assert asked == [("photo", "c")] and "a fault" in capsys.readouterr().err
