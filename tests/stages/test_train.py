"""The stage `train`: repeatable, and its short runs are already of use."""

import json

import pyarrow.parquet as pq
import pytest
from safetensors import safe_open

from factorlib.__main__ import project
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED
from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.project import LIBRARY
from factorlib.runner.store import copy_shipped
from factorlib.stage import Inputs, silent
from stages import train
from tests.stages.made import Killed, ran

BRIEF = {"samples": 8192, "held_out": 2048, "steps": 160, "diffuse_steps": 120, "rate": 0.01}
TINY = {"samples": 1024, "held_out": 1024, "steps": 80, "diffuse_samples": 1024, "diffuse_steps": 80, "batch": 256}


@pytest.mark.long
def test_a_brief_training_already_beats_the_formula_and_says_how(tmp_path):
    trained = ran(train, Inputs({}), tmp_path, silent, **BRIEF)
    accuracy = json.loads((trained / "accuracy.json").read_text())["specular"]
    assert accuracy["median"] < 0.013  # the formula's own, see tests/reflection
    assert set(accuracy) >= {"roughness", "sharpness", "cosine of the view", "degrees from the mirror direction"}
    curve = pq.read_table(trained / "training.parquet").to_pydict()
    specular = [e for e, part in zip(curve["held_out_p95_error"], curve["part"], strict=True) if part == "specular"]
    assert specular[-1] < 0.7 * specular[0]
    with safe_open(trained / "specular.safetensors", framework="pt") as file:
        assert json.loads(file.metadata()["factorlib"])["sizes"] == [24, 32, 32, 32, 1]
    assert reflection_operator("network", weights=trained).layers["specular"].weights[0].shape == (32, 24)


def test_a_killed_training_goes_on_to_the_same_bytes(tmp_path):
    inputs, whole, points = Inputs({}, unfinished=tmp_path / "unfinished"), [], []
    ran(train, Inputs({}), tmp_path / "whole", lambda *words: whole.append(words[-1]), **TINY)

    def killed_amid_the_second_part(done, total, text=""):
        points.append(text)
        if sum(each.startswith("specular: held-out") for each in points) == 5:
            raise Killed

    with pytest.raises(Killed):
        ran(train, inputs, tmp_path / "out", killed_amid_the_second_part, **TINY)
    points.clear()
    ran(train, inputs, tmp_path / "out", lambda *words: points.append(words[-1]), **TINY)
    second = [text for text in whole if text.startswith("specular")]
    assert all(text.startswith("specular") for text in points) and len(points) < len(second), "it started again"
    for path in (tmp_path / "whole").iterdir():
        assert path.read_bytes() == (tmp_path / "out" / path.name).read_bytes(), path.name


def test_shipped_weights_are_of_this_stage_and_within_the_bounds(tmp_path):
    """`make train` makes the shipped weights again; these are the errors that it must reach.

    Where the last line fails, sources of the training changed: see "A BRDF" in CONTRIBUTING.md.
    """
    accuracy = json.loads((SHIPPED / "accuracy.json").read_text())
    assert accuracy["specular"]["samples"] == train.Params().held_out
    assert accuracy["specular"]["median"] < 0.003 and accuracy["specular"]["p95"] < 0.02
    assert accuracy["diffuse"]["p95"] < 0.005
    state = read_state(project(), Request("eames", ["train"]))
    shipping = state.spec.pipeline.stages["train"].shipped
    assert copy_shipped([LIBRARY], shipping, state.plan()[0].record, tmp_path / "out")
