"""Pairs: what is right is not told apart, what is wrong is named."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.read import read_dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose
from factorlib.geometry.raster import rasterise
from factorlib.jsonfile import write_json
from factorlib.recipe.schema import Insert
from factorlib.render.solved_set import SolvedSet
from factorlib.results.materials import Reflectance
from factorlib.runner.project import LIBRARY
from factorlib.stage import Inputs
from stages import masks
from studies import pairs as scene
from studies.errors import times
from studies.steps.photos import run_stages
from tests.export import made_export

GROUND = {"ground": {"point": [0, 1.2, 4], "normal": [0, -1, -0.2], "diffuse": [0.3, 0.3, 0.3]}}


@pytest.fixture(scope="module")
def inputs():
    made = made_export.shared()[0]
    facts = made.facts | {"dataset.ground": dict.fromkeys(made_export.MESHES, GROUND)}
    return Inputs(made.folders, facts, made.files)


def altered(inputs, light=1.0, materials=lambda m: m, tilt=0.0):
    """Another truth of the set: its light times a factor, other materials, another ground."""
    facts = inputs.facts | {"dataset.ground": dict.fromkeys(made_export.MESHES, GROUND)}
    facts["dataset.ground"]["front"] = {"ground": GROUND["ground"] | {"normal": [tilt, -1, -0.2]}}
    truth = SolvedSet(Inputs(inputs.folders, facts, inputs.files))
    own, truth.materials = truth.light, {name: materials(m) for name, m in truth.materials.items()}
    truth.light = lambda name: own(name).scaled(light)
    return truth


def mixed(m):
    """As much reflectance as a material has, differently split, and rougher."""
    half = tuple(((np.array(m.diffuse) + m.specular) / 2).tolist())
    return Reflectance(half, half, 0.9)


HALF = {"light": 2.0, "materials": lambda m: times(m, np.full(3, 0.5))}  # what no photograph tells
WRONG = [({}, ""), (HALF, ""), ({"light": 0.4}, "light"), ({"materials": mixed}, "material"), ({"tilt": 0.5}, "ground")]


@pytest.mark.parametrize("how, cause", WRONG, ids=["same", "gauge", "light", "material", "ground"])
def test_what_is_right_is_not_told_apart_and_what_is_wrong_is_named(inputs, how, cause):
    recipe = Insert(mesh="ball", material="red", at=(46.0, 45.0), size=0.5, samples=4)
    (ours, truth), of = scene.drawn("front", recipe, SolvedSet(inputs), altered(inputs, **how))
    assert ours.shape == truth.shape and of["floor"] > 0
    assert of["told_apart"] == bool(cause) and (of["cause"] == cause or not cause)
    right = [name for name in scene.FACTORS if name != cause] + ([] if cause else ["difference"])
    assert [of[name] for name in right] == pytest.approx([0] * len(right), abs=1e-3)


def test_nothing_below_the_floor_is_told_apart():
    photo, body = np.full((40, 40, 3), 0.3), np.zeros((40, 40), bool)
    body[10:25, 10:25] = True
    truth = photo.copy()
    truth[body], truth[25:35, 10:30] = 0.2, 0.15
    parts = dict.fromkeys(scene.FACTORS, truth)
    for mine, its, told in ((1.3, 1.0, True), (2.0, 1.0, False), (1.3, 1.5, False)):
        of = scene.scores((1.3 * truth, truth), (mine * truth, its * truth), parts, photo, body)
        assert of["told_apart"] == told
    assert scene.cielab(np.full((3, 3, 3), [1.0, 0, 0]))[1, 1] == pytest.approx([53.24, 80.09, 67.20], abs=0.05)


def test_pairs_are_the_seeds_evenly_spread_and_stand_where_neither_set_refuses_or_moves_them(inputs, monkeypatch):
    recovered, truth = SolvedSet(inputs), SolvedSet(inputs)

    def standing(recipe, results, photo):
        if recipe.at[0] < 30 and results is recovered:
            raise InputError("refused")
        return SimpleNamespace(moved="moved" if recipe.at[0] > 45 and results is truth else "")

    monkeypatch.setattr(scene, "standing", standing)
    first, again, other = (list(scene.chosen({"made": (recovered, truth)}, 20, 4, seed)) for seed in (1, 1, 2))
    assert first == again != other and all(30 <= recipe.at[0] <= 45 for _, _, recipe in first)
    for values in zip(*((photo, r.mesh, r.material) for _, photo, r in first), strict=True):
        assert np.ptp(np.unique(values, return_counts=True)[1]) == 0
    monkeypatch.setattr(scene, "PLACES", 0)
    with pytest.raises(InputError, match="has no place"):
        list(scene.chosen({"made": (recovered, truth)}, 1, 4, 1))


def test_the_truth_puts_chairs_on_the_ground_where_the_masks_show_them(inputs, tmp_path):
    dataset = read_dataset(LIBRARY / "data/eames")
    run_stages(dataset, tmp_path, (masks,))
    slices = ("materials", "objects", "light", "ground")
    facts = {f"dataset.{name}": dataset_slice(dataset, name).facts for name in slices}
    lens, turned = {"focal_px": 999.0, "principal_point": [1.0, 2.0]}, {"rotation": np.eye(3), "translation": [0, 0, 5]}
    poses = {name: {"camera": lens, "objects": dict.fromkeys(of, turned)} for name, of in dataset.truth.poses.items()}
    (tmp_path / "align").mkdir()
    write_json(tmp_path / "align/poses.json", msgspec.to_builtins(poses, enc_hook=np.ndarray.tolist))
    folders = {"masks": tmp_path / "masks", "align": tmp_path / "align", "export": inputs["export"]}
    chair = {"meshes/chair.obj": dataset.folder / "meshes/chair.obj"}
    truth = scene.Truth(Inputs(folders, facts, chair), dataset)
    there, known, still = truth.scene("hall"), truth.covered("hall"), Pose(YUP_FROM_CAMERA, np.zeros(3))
    chairs = [msgspec.structs.replace(of.mesh, vertices=of.vertices) for of in there.objects]
    shown = rasterise(chairs, there.camera, [still, still]).label > 0
    assert (shown & known).sum() / (shown | known).sum() > 0.9
    for placed in there.objects:
        plane = truth.ground("hall", placed).plane
        heights = (placed.vertices - plane.point) @ plane.normal
        assert abs(heights.min()) < 0.01 and 0.7 < heights.max() < 0.9
    with pytest.raises(InputError, match="no set of chairs"):
        scene.Truth(inputs, read_dataset(LIBRARY / "data/synthetic"))
