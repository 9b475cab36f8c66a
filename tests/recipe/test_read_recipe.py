"""Recipes: what is written is read, what is not there is named, and every recipe that comes with the project is good."""

from pathlib import Path

import msgspec
import pytest

from factorlib.dataset.read_dataset import read_dataset
from factorlib.jsonfile import write_json
from factorlib.recipe.kinds import KINDS, InsertRecipe, materials_of, read_table, recipe_of
from factorlib.recipe.read_recipe import files_of, read_recipe
from factorlib.results.materials import MaterialTable, Reflectance, StandardErrors, attach_errors
from factorlib.runner.project import LIBRARY
from factorlib.yamlfile import load_yaml, read_yaml
from tests.faults.sample import put
from tests.refusal import refusal

EAMES = LIBRARY / "data" / "eames"
RECIPES = sorted((LIBRARY / "recipes").glob("*.yaml")) + sorted((LIBRARY / "recipes" / "eames").glob("*.yaml"))
OF_OTHER_SETS = set((LIBRARY / "recipes").rglob("*.yaml")) - set(RECIPES)  # sets that do not come with the project


@pytest.fixture(scope="module")
def dataset():
    return read_dataset(EAMES)


def written(folder: Path, text: str) -> Path:
    return put(folder / "one.yaml", text)


def test_recipes_that_come_with_the_project_are_good_and_of_every_kind_and_survive_the_way_to_a_stage(dataset):
    recipes = [read_recipe(path, dataset) for path in RECIPES]
    assert [recipe_of(msgspec.to_builtins(recipe)) for recipe in recipes] == recipes
    assert {type(recipe) for recipe in recipes} == set(KINDS.values())
    assert all(read_yaml(path, KINDS[load_yaml(path)["kind"]]) for path in OF_OTHER_SETS)


@pytest.mark.parametrize("text, words", [
    ("kind: relight\nphotos: [kitchn]", ["photos", "unknown photo 'kitchn'", "did you mean 'kitchen'"]),
    ("kind: relight\nlights: [hal]", ["lights", "did you mean 'hall'"]),
    ("kind: relight\nlights: [studio.hdr]", ["there is no file 'studio.hdr'", "relative to the recipe"]),
    ("kind: relightt", ["there is no kind 'relightt'", "did you mean 'relight'"]),
    ("samples: 3", ["does not say what kind", "turntable"]),
    ("[1, 2]", ["does not say what kind"]),
    ("kind: [insert]", ["there is no kind"]),
    ("kind: insert\nsiz: 3", ["one.yaml:2: siz", "did you mean 'size'"]),
    ("kind: insert\nmesh: char", ["unknown mesh 'char'", "did you mean 'chair'"]),
    ("kind: insert\nmesh: x.obj", ["there is no file 'x.obj'"]),
    ("kind: insert\nmaterial: redd", ["did you mean 'red'"]),
    ("kind: insert\nphotos: [kitchen]\nbeside: red_chair", ["no object 'red_chair' in photo 'kitchen'", "yellow_chair", "name the photos"]),
    ("kind: insert\nsize: 0", ["one.yaml:2: size"]),
    ("kind: insert\nmesh: read.py", ["there is no file", "read.py"]),
    ("kind: insert\nmesh: one.yaml", ["'one.yaml' is not a mesh file", ".obj"]),
    ("kind: relight\nphotos: [kitchen, kitchen]", ["photos", "'kitchen' is named twice"]),
    ("kind: relight\nlights: [hall, hall]", ["lights", "'hall' is named twice"]),
    ("kind: turntable\nseconds: .inf", ["one.yaml:2: seconds"]),
    ("kind: turntable\nseconds: 3600", ["one.yaml:2: seconds", "<= 1200"]),
    ("kind: view\nzoom: 1e-300", ["one.yaml:2: zoom", ">= 0.01"]),
    ("kind: insert\ntable: one.yaml", ["one.yaml", "a table of materials"]),
    ("kind: transfer\nmaterials: {yelow: red}", ["did you mean 'yellow'"]),
    ("kind: transfer\nmaterials: {yellow: gold}", ["unknown material 'gold'"]),
    ("kind: transfer", ["materials"]),
    ("kind: insert\nmesh: chair\nmaterial: {red: blak}", ["material", "did you mean 'black'"]),
    ("kind: insert\nmaterial: {red: black}", ["material", "mesh of the data set", "name one material"]),
    ("kind: view\nsamples: 0", ["one.yaml:2: samples"]),
    ("kind: view\nacross: 600\nwidth: 600", ["across", "cannot be combined with width"]),
    ("kind: insert\nmaterial: gold\ntable: {golt: {diffuse: [0, 0, 0], specular: [0, 0, 0], roughness: 1}}", ["did you mean 'golt'"]),
    ("kind: insert\ntable: {gold: {diffuse: [0, 0, 0], specular: [0, 0, 300], roughness: 1}}", ["gold", "0 to 1"]),
    ("kind: insert\ntable: {gold: {diffuse: [0.5, 0, 0], specular: [0, 0.6, 0], roughness: 1}}", ["one.yaml", "table.gold", "more light"]),
])  # fmt: skip
def test_what_is_wrong_is_named_with_a_cure(text, words, dataset, tmp_path):
    error = refusal(".", read_recipe, written(tmp_path, text), dataset)
    assert all(word in str(error) for word in words), str(error)


def test_photos_of_one_light_are_relit_by_maps_only(dataset, tmp_path):
    photos = [msgspec.structs.replace(photo, illumination="room") for photo in dataset.spec.photos]
    one = msgspec.structs.replace(dataset, spec=msgspec.structs.replace(dataset.spec, photos=photos))
    error = refusal("share one light, 'room'", read_recipe, written(tmp_path, "kind: relight"), one)
    assert error.key == "lights" and ".hdr" in error.cure
    (tmp_path / "beach.hdr").write_text("")
    path = written(tmp_path, "kind: relight\nlights: [beach.hdr]")
    assert files_of(read_recipe(path, one), path) == {"beach.hdr": tmp_path / "beach.hdr"}


def test_files_are_relative_to_the_recipe_and_a_table_adds_materials(dataset, tmp_path):
    (tmp_path / "bunny.obj").write_text("")
    one = attach_errors(Reflectance((0.1,) * 3, (0.5,) * 3, 0.2), StandardErrors((0.0,) * 3, (0.0,) * 3, 0.0))
    write_json(tmp_path / "own.json", MaterialTable({"gold": one}))
    path = written(tmp_path, "kind: insert\nmesh: bunny.obj\nmaterial: gold\ntable: own.json")
    recipe = read_recipe(path, dataset)
    assert isinstance(recipe, InsertRecipe) and recipe.material == "gold"
    assert files_of(recipe, path) == {"own.json": tmp_path / "own.json", "bunny.obj": tmp_path / "bunny.obj"}
    inside = "table: {gold: {diffuse: [0.1, 0.1, 0.1], specular: [0.5, 0.5, 0.5], roughness: 0.2}}"
    path = written(tmp_path, f"kind: insert\nmaterial: gold\n{inside}")
    recipe = read_recipe(path, dataset)
    assert isinstance(recipe, InsertRecipe) and files_of(recipe, path) == {}
    assert materials_of(recipe.table, path) == read_table(tmp_path / "own.json")
    assert recipe_of(msgspec.to_builtins(recipe)) == recipe
