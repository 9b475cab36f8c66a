"""`factorlib.load_result`: what was solved, in Python; and the Python that README.md and docs/ show of it, on a small result."""

import ast
import json
import re
import shutil

import msgspec
import numpy as np
import pytest

import factorlib
from factorlib.errors import InputError
from factorlib.images.exr import read_exr, read_rgb_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.picture import read_png
from factorlib.recipe import kinds
from factorlib.runner.project import LIBRARY
from factorlib.stage import silent
from stages import recipes
from tests.export import made_export
from tests.refusal import refusal
from tests.runner.toy import files_of
from tests.stages.made import ran


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_export.make_result(tmp_path_factory.mktemp("root"))


@pytest.fixture(scope="module")
def result(folder):
    return factorlib.load_result(folder)


def test_materials_have_their_numbers_and_standard_errors(result):
    assert list(result.materials) == made_export.NAMES and result.materials["red"].roughness == 0.35
    assert result.materials["red"].stderr.roughness == 0.1
    assert result.objects == ["front/chair", "side/chair"]


def test_what_is_not_there_is_refused_with_what_is(result, tmp_path):
    for ask, words in [
        (lambda: result.materials["rde"], "did you mean 'red'"),
        (lambda: result.environment("frnt"), "did you mean 'front'"),
        (lambda: result.relight("chiar", "front"), "did you mean 'chair'"),
        (lambda: result.relight("chair", "sde"), "did you mean 'side'"),
        (lambda: result.relight("chair", None), "known are: 'front', 'side'"),
        (lambda: result.relight("chair", tmp_path / "none.hdr"), "none.hdr"),
        (lambda: result.relight(3, "side"), "known are: 'chair', 'front/chair', 'side/chair'"),
        (lambda: result.render("nothing"), "known are: 'front', 'side'"),
        (lambda: result.render(view=None), "known are: 'front', 'side'"),
        (lambda: result.scene("sid"), "did you mean 'side'"),
        (lambda: result.materials[["red"]], "did you mean 'red'"),
        (lambda: result.render("front", width=0), "width: expected `int` >= 8"),
        (lambda: result.render("front", zoom=np.float64(0)), "zoom: expected `float` >= 0.01"),
        (lambda: result.relight("chair", "side", samples=0), "samples: expected `int` >= 1"),
        (lambda: result.insert("frnt"), "did you mean 'front'"),
        (lambda: result.insert("front", mesh="eggs"), "did you mean 'egg'"),
        (lambda: result.insert("front", beside="table"), "whose objects are: chair"),
        (lambda: result.insert("front", material="rde"), "did you mean 'red'"),
        (lambda: result.insert("front", mesh="none.obj"), "there is no file 'none.obj'"),
        (lambda: result.insert("front", siz=1), "did you mean 'size'"),
        (lambda: result.transfer("front", {"rde": "red"}), "did you mean 'red'"),
        (lambda: result.turntable("front", frames=1), "frames: expected `int` >= 2"),
        (lambda: factorlib.load_result(123), "not by int 123"),
        (lambda: factorlib.load_result(tmp_path), "there is no result here"),
        (lambda: factorlib.load_result("a\0b"), "there is no result here"),
        (lambda: factorlib.load_result(300 * "a"), "there is no result here"),
        (lambda: factorlib.nothing, "has no attribute 'nothing'"),
    ]:
        with pytest.raises((InputError, AttributeError)) as error:
            ask()
        assert words in str(error.value)


def test_a_folder_that_is_no_result_is_refused_with_those_that_are(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder.parent.parent)
    assert factorlib.load_result("set").photos == factorlib.load_result("build/set").photos
    for name, result, cure in [
        ("build/sett", "there is no result here", "did you mean 'build/set'"),
        ("data/set", "there is no result here", "build/set"),
        ("build/set/export", "this is a part of a result", 'load_result("build/set")'),
        ("build/set/export/materials.json", "this is a part of a result", 'load_result("build/set")'),
        ("build/set/exprt", "there is no result here", "build/set"),
    ]:
        assert cure in str(refusal(result, factorlib.load_result, name))
    monkeypatch.chdir(folder / "masks")
    refusal(r'load_result\("\.\."\)|load_result\("\.\./\.\./\.\./build/set"\)', factorlib.load_result, "../export")
    monkeypatch.chdir(tmp_path)
    refusal("make all DATASET=<name> makes one", factorlib.load_result, "nothing")


@pytest.fixture
def copy(folder, tmp_path):
    """Of the checkout."""
    shutil.copytree(folder.parent.parent, tmp_path / "root")
    return tmp_path / "root"


@pytest.mark.parametrize("path, text, words", [
    ("export", None, ["export is missing", "make all DATASET=set"]),
    ("export/dataset.json", None, ["has no facts of its data set", "make export DATASET=set"]),
    ("export/dataset.json", "[]", ["dataset.json", "make export DATASET=set"]),
    ("export/dataset.json", "", ["dataset.json", "run its stage again"]),
])  # fmt: skip
def test_a_result_that_is_not_whole_is_refused_with_a_cure(copy, path, text, words):
    place = copy / "build" / "set" / path
    if text is None:
        place.rename(copy / "elsewhere")
    else:
        place.write_text(text)
    error = refusal(".", factorlib.load_result, copy / "build" / "set")
    assert all(word in str(error) for word in words), str(error)


def test_environments_are_the_exported_ones_turned_and_written(result, folder, tmp_path):
    light = result.environment("side")
    assert np.array_equal(light.lat_long, read_rgb_exr(folder / "export" / "illumination" / "room.exr"))
    light.to_exr(tmp_path / "room.exr")
    light.to_hdr(tmp_path / "room.hdr")
    actual, brightest = read_light_map(tmp_path / "room.hdr"), light.lat_long.max(axis=-1, keepdims=True)
    assert (np.abs(actual - light.lat_long) <= brightest / 128).all()
    assert np.array_equal(read_rgb_exr(tmp_path / "room.exr"), light.lat_long.astype(np.float32))
    spot = factorlib.result.Environment(np.zeros((16, 32, 3)))
    spot.lat_long[8, 16] = 1  # toward the viewer
    assert spot.rotate(90).lat_long.sum(axis=(0, 2)).argmax() in (7, 8)  # +x is a quarter from the left


def test_pictures_are_those_of_the_photo(result, tmp_path):
    picture = result.render("front", samples=4)
    covered = read_exr(result.folder / "align" / "front.exr")["confidence"] > 0
    assert ((picture.pixels[..., 3] > 0.5) == covered).mean() > 0.98
    picture.to_png(tmp_path / "front.png")
    picture.to_exr(tmp_path / "front.exr")
    assert read_png(tmp_path / "front.png").shape == (*covered.shape, 4)
    assert result.render("front", azimuth=90, width=32, samples=1).pixels.shape == (28, 32, 4)


def test_an_object_in_another_light_is_that_lights_colour(result, tmp_path):
    red = factorlib.result.Environment(np.broadcast_to([1.0, 0.0, 0.0], (16, 32, 3)).copy())
    red.to_exr(tmp_path / "red.exr")
    for light in (red, str(tmp_path / "red.exr")):
        pixels = result.relight("front/chair", light, samples=2).pixels
        assert pixels[..., 0].max() > 0 and not pixels[..., 1:3].any()
    assert result.relight("chair", "side", samples=1).pixels[..., :3].any()


FRONT = {"photos": ["front"], "samples": 1}
ASKED = [
    (kinds.InsertRecipe(**FRONT), lambda r: r.insert("front", samples=np.int64(1))),
    (kinds.TurntableRecipe(**FRONT, frames=2), lambda r: r.turntable("front", frames=2, samples=1)),
    (
        kinds.TransferRecipe(**FRONT, materials={"red": "unseen"}),
        lambda r: r.transfer("front", {"red": "unseen"}, samples=1),
    ),
]


@pytest.mark.parametrize("recipe, ask", ASKED)
def test_pictures_that_recipes_make_are_the_same_files(result, tmp_path, recipe, ask):
    (drawn := ask(result)).save(tmp_path / "saved")
    inputs = result._solved.inputs
    facts = inputs.facts | {"recipe": msgspec.to_builtins(recipe)}
    out = ran(recipes, msgspec.structs.replace(inputs, facts=facts), tmp_path / "stage", silent)
    assert files_of(tmp_path / "saved") == files_of(out) == drawn
    assert drawn._repr_html_().startswith('<img src="data:image/')


# ── the pages: names of the small result stand in place of those of data/eames ───────────────────────────────────────

SMALL = {
    "build/eames": "build/set", "kitchen": "side", "garden": "front", "terrace": "front", "yellow_chair": "chair",
    "kitchn": "sid", "width=320": "width=32, samples=4", "size=0.4": "size=0.4, samples=1",
    "frames=12": "frames=2, samples=1", '{"yellow": "black"})': '{"red": "unseen"}, samples=1)', '"black"': '"unseen"',
}  # fmt: skip


def run(code, names):
    """As a notebook does: the HTML of the last line's value, where it is an expression that has some."""
    for name, small in SMALL.items():
        code = code.replace(name, small)
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    value = None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return value._repr_html_() if hasattr(value, "_repr_html_") else None


def test_the_notebook_runs_in_its_own_folder_and_shows_its_tables_and_pictures(folder, monkeypatch, capsys):
    (docs := folder.parent.parent / "docs").mkdir()
    monkeypatch.chdir(docs)
    cells, names = json.loads((LIBRARY / "docs" / "result.ipynb").read_text())["cells"], {}
    shown = [run("".join(cell["source"]), names) for cell in cells if cell["cell_type"] == "code"]
    shown = [html for html in shown if html]
    assert [html[:4] for html in shown] == ["<p>.", *["<img"] * 8]
    assert "0.350 ± 0.100" in shown[0] and "front, side" in shown[0]
    output = capsys.readouterr().out
    assert "roughness 0.350 ± 0.100" in output
    assert all(words in output for words in ("did you mean 'red'", "did you mean 'side'", "did you mean 'chair'"))
    assert {path.name for path in docs.iterdir()} == {"pictures"}
    names = {"chair.exr", "chair.png", "side_turned.exr", "side_turned.hdr", "front.exr", "front.json", "front.png"}
    assert {path.name for path in (docs / "pictures").iterdir()} == names


@pytest.mark.parametrize("page", ["README.md", "docs/recipes.md"])
def test_the_examples_of_the_pages_run(folder, page, tmp_path, monkeypatch):
    (tmp_path / "build").symlink_to(folder.parent)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (LIBRARY / page).read_text(), re.DOTALL)
    (code,) = [block for block in blocks if "load_result" in block]
    run(code, {})
