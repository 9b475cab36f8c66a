"""The stage `recipes`: the files of every kind, what they show, the same bytes again, and what it refuses."""

import msgspec
import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.exr import read_exr, write_rgb_exr
from factorlib.images.picture import picture, read_png
from factorlib.jsonfile import write_json
from factorlib.recipe import schema
from factorlib.results.materials import MaterialTable, Reflectance, StandardErrors, solved
from factorlib.stage import Inputs, silent
from stages import recipes
from tests.export import made_export

ERROR = StandardErrors((0.0,) * 3, (0.0,) * 3, 0.0)


@pytest.fixture
def made():
    return made_export.shared()[0]


def changed(made, fact, value):
    return Inputs(made.folders, {**made.facts, fact: value}, made.files)


def drawn(made, out, recipe, **files):
    facts = {**made.facts, "recipe": msgspec.to_builtins(recipe)}
    given = {f"recipe file:{name}": path for name, path in files.items()}
    out.mkdir()
    recipes.main(recipes.Params(), Inputs(made.folders, facts, {**made.files, **given}), out, silent)
    return {str(path.relative_to(out)): path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}


GROUND = {"ground": {"point": [0, 1.2, 4], "normal": [0, -1, -0.2], "diffuse": None}}
PICTURES = {"front": ["front.exr", "front.png"], "side": ["side.exr", "side.png"]}
FRONT = {"photos": ["front"], "samples": 1}
KINDS = [
    (schema.Resynthesis(samples=1), PICTURES["front"] + PICTURES["side"]),
    (schema.View(photos=["side"], samples=1, width=32, background="light"), PICTURES["side"]),
    (schema.Turntable(**FRONT, frames=3), ["front.gif", *(f"front/00{k}.png" for k in range(3))]),
    (schema.MovingLight(**FRONT, frames=2, width=16), ["front.gif", "front/000.png", "front/001.png"]),
    (schema.Relight(samples=1, rotate=30.0, photos=["side"]), [f"side/{name}" for name in PICTURES["front"]]),
    (schema.Transfer(materials={"red": "unseen"}, **FRONT), PICTURES["front"]),
    (schema.Insert(**FRONT), PICTURES["front"]),
    (schema.Insert(**FRONT, mesh="egg", material="brass", at=(40.0, 50.0)), PICTURES["front"]),
    (schema.Grid(samples=1, size=16), ["grid.exr", "grid.png", "grid.txt"]),
]  # fmt: skip


@pytest.mark.parametrize("recipe, files", KINDS, ids=lambda value: type(value).__name__)
def test_files_of_every_kind_and_the_same_bytes_again(made, tmp_path, recipe, files):
    made = changed(made, "dataset.ground", dict.fromkeys(made_export.MESHES, GROUND))
    first, second = (drawn(made, tmp_path / name, recipe) for name in "ab")
    assert sorted(first) == sorted(files) and first == second


def test_the_photo_stays_where_no_object_is(made, tmp_path):
    drawn(made, tmp_path / "out", schema.Resynthesis(photos=["front"], samples=4))
    masks = read_exr(made["masks"] / "front.exr")
    photo = picture(np.stack([masks[c] for c in "RGB"], axis=-1), 1.0)
    found, empty = read_png(tmp_path / "out" / "front.png"), read_exr(made["align"] / "front.exr")["label"] == 0
    far = ~np.any([np.roll(~empty, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    assert np.array_equal(found[far], photo[far]) and not np.array_equal(found[~empty], photo[~empty])


def own_material(made, tmp_path, material):
    write_json(tmp_path / "own.json", MaterialTable({"own": solved(material, ERROR)}))
    recipe = schema.Transfer(photos=["front"], materials={"red": "own"}, table="own.json", samples=4)
    drawn(made, tmp_path / "out", recipe, **{"own.json": tmp_path / "own.json"})


def test_a_material_of_ones_own_is_what_is_drawn(made, tmp_path):
    own_material(made, tmp_path, Reflectance((0.0,) * 3, (0.0,) * 3, 1.0))
    inside = read_exr(made["align"] / "front.exr")["confidence"] > 0
    assert (read_exr(tmp_path / "out" / "front.exr")["G"][inside] == 0).mean() > 0.9


def test_a_material_that_reflects_more_than_arrives_is_refused(made, tmp_path):
    with pytest.raises(InputError, match="more light is reflected than arrives"):
        own_material(made, tmp_path, Reflectance((0.9,) * 3, (0.3,) * 3, 0.5))


def test_the_light_of_a_file_is_used_as_it_lies(made, tmp_path):
    """Light from +x is a quarter of the map's width from its left edge: the right side of the ball is lit."""
    lat_long = np.full((16, 32, 3), 0.01)
    lat_long[6:10, 7:9] = 50.0
    write_rgb_exr(tmp_path / "lamp.exr", lat_long)
    recipe = schema.Relight(photos=["front"], lights=["lamp.exr"], samples=64)
    drawn(made, tmp_path / "out", recipe, **{"lamp.exr": tmp_path / "lamp.exr"})
    picture = read_exr(tmp_path / "out" / "front" / "lamp.exr")
    columns = np.nonzero(picture["A"].max(axis=0))[0]
    left, right = np.array_split(columns, 2)
    assert picture["R"][:, right].sum() > 3 * picture["R"][:, left].sum()


def test_a_photo_without_objects_is_refused_or_left_out_with_a_warning_where_nobody_named_it(made, tmp_path, caplog):
    nothing = {"camera": {}, "objects": [], "meshes": {}}
    some = changed(made, "dataset.objects", {**made.facts["dataset.objects"], "front": nothing})
    with pytest.raises(InputError, match="'front' has no objects to draw"):
        drawn(some, tmp_path / "named", schema.Resynthesis(photos=["front"]))
    assert sorted(drawn(some, tmp_path / "out", schema.Resynthesis(samples=1))) == PICTURES["side"]
    assert "front: left out" in caplog.text
    none = changed(made, "dataset.objects", dict.fromkeys(made_export.MESHES, nothing))
    with pytest.raises(InputError, match="no objects"):
        drawn(none, tmp_path / "none", schema.Resynthesis())


def test_nothing_is_put_on_a_ground_that_is_seen_from_below(made, tmp_path):
    above = {"ground": {"point": [0, -1, 4], "normal": [0, -1, 0]}}  # y is down
    below = {**made.facts["dataset.ground"], "front": above}
    with pytest.raises(InputError, match="'front' was taken from below"):
        drawn(changed(made, "dataset.ground", below), tmp_path / "out", schema.Insert(photos=["front"], samples=1))


def test_a_mesh_without_height_or_that_is_not_there_is_refused(made, tmp_path):
    made = changed(made, "dataset.ground", dict.fromkeys(made_export.MESHES, GROUND))
    with pytest.raises(InputError, match="there is no mesh 'egf'") as error:
        drawn(made, tmp_path / "none", schema.Insert(photos=["front"], mesh="egf", samples=1))
    assert error.value.cure == "did you mean 'egg'?" and error.value.key == "mesh"
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 0 1\nv 0 0 1\nf 1 2 3 4\n")
    recipe = schema.Insert(photos=["front"], mesh="flat.obj", samples=1)
    with pytest.raises(InputError, match="'flat.obj' has no height") as error:
        drawn(made, tmp_path / "out", recipe, **{"flat.obj": tmp_path / "flat.obj"})
    assert "up: z" in error.value.cure
