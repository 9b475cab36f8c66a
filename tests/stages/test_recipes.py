"""The stage `recipes`: the files of every kind, what they show, the same bytes again, and what it refuses."""

import json
import shutil

import msgspec
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.images.exr import read_exr, read_rgb_exr, write_exr, write_rgb_exr
from factorlib.images.picture import picture, read_png
from factorlib.jsonfile import write_json
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.meshes.read_mesh import read_mesh
from factorlib.meshes.subdivision import subdivided_mesh
from factorlib.recipe import kinds
from factorlib.render.insertion import LUMINANCE, ShadowMatch
from factorlib.render.photo_scene import UP, LightMap, rotate_light, traced_photo
from factorlib.render.recipe_pictures import insertion_scene
from factorlib.render.solved_set import SolvedSet
from factorlib.results.materials import MaterialTable, Reflectance, StandardErrors, attach_errors
from factorlib.results.texture_table import FACTORS, FILE, TextureTable, write_factors
from factorlib.stage import Inputs, silent
from stages import recipes
from tests.export import made_export
from tests.refusal import refusal
from tests.runner.toy import files_of
from tests.stages.made import ran

ERROR = StandardErrors((0.0,) * 3, (0.0,) * 3, 0.0)
WORLD = made_export.WORLD_FROM_CAMERA["side"]


@pytest.fixture
def inputs():
    return made_export.shared()[0]


def changed(inputs, fact, value):
    return Inputs(inputs.folders, {**inputs.facts, fact: value}, inputs.files)


def drawn(inputs, out, recipe, **files):
    facts = {**inputs.facts, "recipe": msgspec.to_builtins(recipe)}
    files_by_field = {f"recipe file:{name}": path for name, path in files.items()}
    return files_of(ran(recipes, Inputs(inputs.folders, facts, {**inputs.files, **files_by_field}), out, silent))


@pytest.fixture
def grounded(inputs):
    """The same with a ground in every photo."""
    return changed(inputs, "dataset.ground", dict.fromkeys(made_export.MESHES, GROUND))


GROUND = {"ground": {"point": [0, 1.2, 4], "normal": [0, -1, -0.2], "diffuse": None}}
PICTURES = {"front": ["front.exr", "front.png"], "side": ["side.exr", "side.png"]}
FRONT = {"photos": ["front"], "samples": 1}
KINDS = [
    (kinds.ResynthesisRecipe(samples=1), PICTURES["front"] + PICTURES["side"]),
    (kinds.ViewRecipe(photos=["side"], samples=1, width=32, background="light"), PICTURES["side"]),
    (kinds.ViewRecipe(photos=["side"], samples=1, azimuth=180, floor=0.5), [*PICTURES["side"], "side.json"]),
    (kinds.TurntableRecipe(**FRONT, frames=3), ["front.gif", *(f"front/00{k}.png" for k in range(3))]),
    (kinds.MovingLightRecipe(**FRONT, frames=2, width=16), ["front.gif", "front/000.png", "front/001.png"]),
    (kinds.RelightRecipe(samples=1, rotate=30.0, photos=["side"]), ["side.json", *(f"side/{name}" for name in PICTURES["front"])]),
    (kinds.TransferRecipe(materials={"red": "unseen"}, **FRONT), PICTURES["front"]),
    (kinds.InsertRecipe(**FRONT), [*PICTURES["front"], "front.json"]),
    (kinds.InsertRecipe(**FRONT, mesh="egg", material="brass", at=(40.0, 50.0)), [*PICTURES["front"], "front.json"]),
]  # fmt: skip


@pytest.mark.parametrize("recipe, files", KINDS, ids=lambda value: type(value).__name__)
def test_files_of_every_kind_and_the_same_bytes_again(grounded, tmp_path, recipe, files):
    first, second = (drawn(grounded, tmp_path / name, recipe) for name in "ab")
    assert sorted(first) == sorted(files) and first == second


def test_paint_stays_with_its_material_and_another_material_has_none(grounded, tmp_path):
    """Of a texture of a half on the red of the egg."""
    egg = read_mesh(grounded.files["egg.obj"], made_export.NAMES, made_export.PARTS["egg"])
    write_factors(tmp_path / FACTORS, {("egg", "red"): np.full((subdivided_mesh(egg, 0.04).nodes, 3), 0.5)})
    write_json(tmp_path / FILE, TextureTable({"egg": 0.04}))
    painted = Inputs({**grounded.folders, "texture": tmp_path}, grounded.facts, grounded.files)
    results = SolvedSet(painted)
    shares = {kind: results.mesh("egg", kind, "y")[0].detail for kind in (None, "unseen")}
    assert 0.2 < (shares[None] == 0.5).mean() < 0.8 and (shares["unseen"] == 1).all()
    side = {"photos": ["side"], "samples": 1}
    recipe = kinds.TransferRecipe(materials={"red": "unseen"}, **side)
    own = kinds.ResynthesisRecipe(**side)
    changes = []
    for number, one in enumerate((recipe, own)):
        pictures = []
        for name, inputs in (("painted", painted), ("plain", grounded)):
            drawn(inputs, tmp_path / f"{name} {number}", one)
            pictures.append(read_rgb_exr(tmp_path / f"{name} {number}" / "side.exr"))
        changes.append(np.abs(pictures[0] - pictures[1]).mean() / pictures[1].mean())
    assert changes[0] < 0.2 * changes[1], changes


def test_a_part_of_an_inserted_mesh_gets_another_material_and_the_rest_keeps_its_own(grounded):
    results = SolvedSet(grounded)
    mesh, materials, _ = results.mesh("egg", {"brass": "unseen"}, "y")
    assert [materials[label - 1] for label in mesh.labels] == ["red", "unseen"]
    error = refusal("no object of the mesh 'egg' has the materials unseen", results.mesh, "egg", {"unseen": "red"}, "y")
    assert error.key == "material"


@pytest.mark.parametrize("correlation, constant, turned, doubtful", [
    (0.3, 0.28, [0.1, 0.2], True), (0.3, 0.28, [0.28, 0.29], False), (0.3, 0.1, [-0.1, 0.31], True),
    (0.3, 0.1, [-0.1, 0.1], False), (0.8, 0.8, [0.8, 0.8], True), (None, None, [], False),
])  # fmt: skip
def test_a_shadow_that_the_photo_contradicts_is_a_warning_of_the_run(
    grounded, tmp_path, monkeypatch, caplog, correlation, constant, turned, doubtful
):
    """One that wrong lights predict as well: turned ones, or the constant one within the deviation over turns."""
    match = ShadowMatch(correlation, constant, 500, turned)
    monkeypatch.setattr("factorlib.render.recipe_pictures.compare_shadow", lambda *arguments: match)
    drawn(grounded, tmp_path / "out", kinds.InsertRecipe(photos=["front"], samples=1))
    caption = json.loads((tmp_path / "out" / "front.json").read_text())["caption"]
    assert [words.count("do not trust the shadow") for words in (caption, caplog.text)] == [doubtful, doubtful]


def test_the_photo_stays_where_no_object_is(inputs, tmp_path):
    drawn(inputs, tmp_path / "out", kinds.ResynthesisRecipe(photos=["front"], samples=4))
    masks = read_exr(inputs["masks"] / "front.exr")
    photo = picture(np.stack([masks[c] for c in "RGB"], axis=-1), 1.0)
    result, empty = read_png(tmp_path / "out" / "front.png"), read_exr(inputs["align"] / "front.exr")["label"] == 0
    far = ~np.any([np.roll(~empty, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    assert np.array_equal(result[far], photo[far]) and not np.array_equal(result[~empty], photo[~empty])


@pytest.mark.parametrize("recipe", [
    kinds.ResynthesisRecipe(**FRONT), kinds.InsertRecipe(photos=["front"], samples=16, size=0.3, at=(14.0, 52.0)),
], ids=["resynthesis", "insert"])  # fmt: skip
def test_a_cut_out_stays_one_and_laid_over_a_backdrop_is_the_picture_over_that_backdrop(
    grounded, tmp_path, monkeypatch, caplog, recipe
):
    monkeypatch.setattr("factorlib.render.recipe_pictures.add_grain", lambda radiance, *_: radiance)
    channels = read_exr(grounded["masks"] / "front.exr")
    alpha = gaussian_filter((channels["label"] > 0).astype(float), 1.0)
    backdrop = 0.3  # grey: alpha holds the luminance of a shadow and not its colour
    pictures = []
    for name, laid in (("cut", False), ("whole", True)):
        photo = np.stack([channels[c] for c in "RGB"], axis=-1)
        photo = alpha[..., None] * photo + (1 - alpha[..., None]) * backdrop if laid else photo
        shutil.copytree(grounded["masks"], tmp_path / name)
        written = {**channels, **dict(zip("RGB", np.moveaxis(photo, -1, 0))), **({} if laid else {"alpha": alpha})}
        write_exr(tmp_path / name / "front.exr", {c: np.ascontiguousarray(v, np.float32) for c, v in written.items()})
        inputs = msgspec.structs.replace(grounded, folders={**grounded.folders, "masks": tmp_path / name})
        ground = {"ground": {**GROUND["ground"], "diffuse": [0.3, 0.3, 0.3]}}
        drawn(
            changed(inputs, "dataset.ground", dict.fromkeys(made_export.MESHES, ground)),
            tmp_path / f"{name} out",
            recipe,
        )
        pictures.append(read_exr(tmp_path / f"{name} out" / "front.exr"))
    cut, whole = (np.stack([each[c] for c in "RGB"], axis=-1) for each in pictures)
    opacity = pictures[0]["A"][..., None]
    assert "A" not in pictures[1] and opacity.min() == 0 and opacity.max() == pytest.approx(1)
    apart = np.abs((cut + (1 - opacity) * backdrop - whole) @ LUMINANCE)
    assert np.quantile(apart, 0.99) < 0.005  # light that the new object sends to the ground is no alpha
    assert ("shows no ground" in caplog.text) == isinstance(recipe, kinds.InsertRecipe)
    if isinstance(recipe, kinds.InsertRecipe):
        assert "shows no ground" in json.loads((tmp_path / "cut out" / "front.json").read_text())["caption"]
        assert ((opacity[..., 0] > 0.05) & (cut.max(-1) < 1e-6)).any()  # the shadow


@pytest.mark.parametrize("camera", [
    {"azimuth": 50.0, "elevation": 20.0}, {"azimuth": 50.0, "floor": 0.5},
])  # fmt: skip
def test_a_relit_picture_from_another_view_is_that_view_in_another_light(inputs, tmp_path, camera):
    """In the photo's own light, which a map stands for, it has the same pixels up to its exposure."""
    common = {"photos": ["front"], "samples": 64, "width": 32, **camera}
    write_rgb_exr(tmp_path / "own.exr", lat_long_of_lobes(SolvedSet(inputs).light("front"), 128, 256))
    drawn(inputs, tmp_path / "view", kinds.recipe_of({"kind": "view", **common}))
    relit = kinds.recipe_of({"kind": "relight", "lights": ["own.exr"], **common})
    drawn(inputs, tmp_path / "relit", relit, **{"own.exr": tmp_path / "own.exr"})
    view, again = (read_exr(path) for path in (tmp_path / "view/front.exr", tmp_path / "relit/front/own.exr"))
    np.testing.assert_allclose(view["A"], again["A"], atol=1e-3)
    sums = [np.array([each[c].sum() for c in "RGB"]) for each in (view, again)]
    np.testing.assert_allclose(sums[0] / sums[0].sum(), sums[1] / sums[1].sum(), rtol=0.05)
    correlation = np.corrcoef(view["G"].ravel(), again["G"].ravel())[0, 1]
    assert correlation > 0.98


def test_a_floor_in_a_hard_sun_is_the_grey_that_it_is_and_not_white(inputs, tmp_path):
    lat_long = np.full((32, 64, 3), 0.02)
    lat_long[6:8, 10:12] = 300.0
    write_rgb_exr(tmp_path / "sun.exr", lat_long)
    recipe = kinds.RelightRecipe(photos=["front"], lights=["sun.exr"], samples=16, floor=0.5, width=48)
    drawn(
        changed(inputs, "dataset.ground", dict.fromkeys(made_export.MESHES, GROUND)),
        tmp_path / "out",
        recipe,
        **{"sun.exr": tmp_path / "sun.exr"},
    )
    picture = read_exr(tmp_path / "out/front/sun.exr")
    full = picture["A"] > 0.99
    brightest = np.max([picture[c] for c in "RGB"], axis=0)[full]
    assert np.quantile(brightest, 0.9) < 0.6 and np.quantile(brightest, 0.99) > 0.3


def own_material(inputs, tmp_path, material):
    write_json(tmp_path / "own.json", MaterialTable({"own": attach_errors(material, ERROR)}))
    recipe = kinds.TransferRecipe(photos=["front"], materials={"red": "own"}, table="own.json", samples=4)
    drawn(inputs, tmp_path / "out", recipe, **{"own.json": tmp_path / "own.json"})


def test_a_material_of_ones_own_is_what_is_drawn(inputs, tmp_path):
    own_material(inputs, tmp_path, Reflectance((0.0,) * 3, (0.0,) * 3, 1.0))
    inside = read_exr(inputs["align"] / "front.exr")["confidence"] > 0
    assert (read_exr(tmp_path / "out" / "front.exr")["G"][inside] == 0).mean() > 0.9


def test_a_material_that_reflects_more_than_arrives_is_refused(inputs, tmp_path):
    refusal(
        "more light is reflected than arrives", own_material, inputs, tmp_path, Reflectance((0.9,) * 3, (0.3,) * 3, 0.5)
    )


def test_the_light_of_a_file_is_used_as_it_lies(inputs, tmp_path):
    """Light from +x is a quarter of the map's width from its left edge: the right side of the ball is lit."""
    lat_long = np.full((16, 32, 3), 0.01)
    lat_long[6:10, 7:9] = 50.0
    write_rgb_exr(tmp_path / "lamp.exr", lat_long)
    recipe = kinds.RelightRecipe(photos=["front"], lights=["lamp.exr"], samples=64)
    drawn(inputs, tmp_path / "out", recipe, **{"lamp.exr": tmp_path / "lamp.exr"})
    picture = read_exr(tmp_path / "out" / "front" / "lamp.exr")
    left, right = np.array_split(np.nonzero(picture["A"].max(axis=0))[0], 2)
    assert picture["R"][:, right].sum() > 3 * picture["R"][:, left].sum()


def test_a_map_of_a_file_relights_as_the_same_map_as_the_light_of_the_set_does(inputs, tmp_path):
    """Of a photo with a tilted world: the map of its light, in the frame of the exported ones, stands where the light does."""
    lobes = made_export.light(1)  # in the camera's frame
    write_rgb_exr(tmp_path / "room.exr", lat_long_of_lobes(lobes.rotate(WORLD), 64, 128))
    results = SolvedSet(
        Inputs(inputs.folders, inputs.facts, {**inputs.files, "recipe file:room.exr": tmp_path / "room.exr"})
    )
    scene = results.scene("side")
    named = results.light("room.exr", "side")
    for turn in (0.0, 70.0):
        own, mapped, wrong = (
            traced_photo(msgspec.structs.replace(scene, light=rotate_light(light, turn, up)), 64)
            for light, up in ((lobes, scene.up), (named, scene.up), (LightMap(named.radiance), UP))
        )
        errors = [np.abs(other - own).mean() / own.mean() for other in (mapped, wrong)]
        assert errors[0] < 0.01 < 0.1 < errors[1], errors
    assert scene.up == pytest.approx(YUP_FROM_CAMERA @ WORLD.T @ [0, -1, 0])


def test_the_light_of_a_photo_stays_fixed_to_the_world_that_two_photos_share_and_comes_once(inputs):
    worlds = {name: {"illumination": "room", "world_from_camera": WORLD.T.tolist()} for name in ("front", "third")}
    some = changed(inputs, "dataset.light", {**inputs.facts["dataset.light"], "front": worlds["front"]})
    results = SolvedSet(some)
    front, side = (results.light("side", photo) for photo in ("front", "side"))
    np.testing.assert_allclose(front.rotate(WORLD.T).axis, side.rotate(WORLD).axis, atol=1e-12)
    assert results.other_lights("front") == [] and SolvedSet(inputs).other_lights("front") == ["side"]


def test_a_ground_that_the_recipe_lowers_lies_so_many_heights_lower_and_the_caption_says_so(grounded, tmp_path):
    results = SolvedSet(grounded)
    plain, low = (
        insertion_scene(kinds.InsertRecipe(photos=["front"], ground=kinds.GroundFields(drop=drop)), results, "front")
        for drop in (0.0, 0.25)
    )
    normal = plain.ground.plane.normal
    height = np.ptp(plain.scene.objects[0].vertices @ normal)
    assert (plain.ground.plane.point - low.ground.plane.point) @ normal == pytest.approx(0.25 * height)
    assert (low.new.vertices @ normal).min() == pytest.approx(low.ground.plane.point @ normal)
    assert low.spot.height == pytest.approx(plain.spot.height)
    assert low.ground.source == "that of dataset.yaml, lowered by 0.25 of its heights as the recipe says"


def test_a_photo_without_objects_is_refused_or_left_out_with_a_warning_where_nobody_named_it(inputs, tmp_path, caplog):
    nothing = {"camera": {}, "objects": [], "meshes": {}}
    some = changed(inputs, "dataset.objects", {**inputs.facts["dataset.objects"], "front": nothing})
    refusal(
        "'front' has no objects to render", drawn, some, tmp_path / "named", kinds.ResynthesisRecipe(photos=["front"])
    )
    assert sorted(drawn(some, tmp_path / "out", kinds.ResynthesisRecipe(samples=1))) == PICTURES["side"]
    assert "front: no picture of this photo" in caplog.text
    none = changed(inputs, "dataset.objects", dict.fromkeys(made_export.MESHES, nothing))
    refusal("no objects", drawn, none, tmp_path / "none", kinds.ResynthesisRecipe())


def test_nothing_is_put_on_a_ground_that_is_seen_from_below(inputs, tmp_path):
    above = {"ground": {"point": [0, -1, 4], "normal": [0, -1, 0]}}  # y is down
    below = {**inputs.facts["dataset.ground"], "front": above}
    refusal(
        "'front' was taken from below",
        drawn,
        changed(inputs, "dataset.ground", below),
        tmp_path / "out",
        kinds.InsertRecipe(photos=["front"], samples=1),
    )
