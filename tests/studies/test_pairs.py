"""Pairs: what is right is not told apart, what is wrong is named."""

import numpy as np
import pytest

from factorlib.recipe.kinds import InsertRecipe
from factorlib.render.solved_set import SolvedSet
from factorlib.results.materials import Reflectance
from factorlib.stage import Inputs
from studies import pairs as scene
from studies.recovery_errors import scale_reflectance
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
    truth.light = lambda name: own(name).scale(light)
    return truth


def mixed(m):
    """As much reflectance as a material has, differently split, and rougher."""
    half = tuple(((np.array(m.diffuse) + m.specular) / 2).tolist())
    return Reflectance(half, half, 0.9)


HALF = {"light": 2.0, "materials": lambda m: scale_reflectance(m, np.full(3, 0.5))}  # what no photograph tells
WRONG = [({}, ""), (HALF, ""), ({"light": 0.4}, "light"), ({"materials": mixed}, "material"), ({"tilt": 0.5}, "ground")]


@pytest.mark.long
@pytest.mark.parametrize("how, cause", WRONG, ids=["same", "gauge", "light", "material", "ground"])
def test_what_is_right_is_not_told_apart_and_what_is_wrong_is_named(inputs, how, cause):
    recipe = InsertRecipe(mesh="ball", material="red", at=(46.0, 45.0), size=0.5, samples=4)
    (ours, truth), of = scene.render_pair("front", recipe, SolvedSet(inputs), altered(inputs, **how))
    assert ours.shape == truth.shape and of["floor"] > 0
    assert of["told_apart"] == bool(cause) and (of["cause"] == cause or not cause)
    right = [name for name in scene.FACTORS if name != cause] + ([] if cause else ["difference"])
    assert [of[name] for name in right] == pytest.approx([0] * len(right), abs=1e-3)
