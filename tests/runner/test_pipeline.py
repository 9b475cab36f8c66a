"""pipeline.yaml: what is refused, and how settings change it."""

import pytest

from factorlib.errors import InputError
from factorlib.runner.pipeline import Pipeline, Stage, read_pipeline, with_settings

GOOD = """format: 1
stages:
  one: {inputs: [dataset.photo], over: photo, gather: all.json}
  two: {inputs: [one], threads: 2, params: {a: 1e-3}}
"""


def read(tmp_path, text):
    (tmp_path / "pipeline.yaml").write_text(text)
    return read_pipeline(tmp_path / "pipeline.yaml", ("photo", "set"))


def test_a_good_one(tmp_path):
    pipeline = read(tmp_path, GOOD)
    assert (
        pipeline.stages["two"].params == {"a": 0.001}
        and pipeline.needed(["one"]) == ["one"]
        and pipeline.order() == ["one", "two"]
    )


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("[one]", "[oen]", ["stages.two.inputs", "did you mean 'one'"]),
        ("dataset.photo", "dataset.foto", ["stages.one.inputs", "did you mean 'dataset.photo'"]),
        ("threads", "thread", ["pipeline.yaml:4", "stages.two.thread", "did you mean 'threads'"]),
        ("threads: 2", "threads: 0", ["pipeline.yaml:4", "stages.two.threads", ">= 1"]),
        ("over: photo, ", "", ["stages.one.gather", "over: photo"]),
        ("over: photo", "over: mesh", ["stages.one.over"]),
        ("[dataset.photo]", "[two]", ["need each other", "one"]),
        ("format: 1", "format: 2", ["format 2"]),
    ],
)
def test_what_is_refused(tmp_path, old, new, words):
    with pytest.raises(InputError) as caught:
        read(tmp_path, GOOD.replace(old, new))
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_settings_reach_into_nested_parameters_and_leave_the_rest():
    pipeline = with_settings(
        Pipeline(1, {"s": Stage(params={"a": 1, "search": {"x": 1, "y": 2}})}), ["s.search.x=3", "s.b=no s.c=1e2"]
    )
    assert pipeline.stages["s"].params == {"a": 1, "search": {"x": 3, "y": 2}, "b": "no", "c": 100.0}


def test_an_optional_stage_runs_only_where_it_is_asked_for(tmp_path):
    pipeline = read(tmp_path, GOOD + "  three: {inputs: [two], optional: true}\n")
    assert pipeline.needed(None) == ["one", "two"] and pipeline.needed(["three"]) == ["one", "two", "three"]
    taken = read(tmp_path, GOOD + "  three: {inputs: [one], optional: true}\n  four: {inputs: [three]}\n")
    assert set(taken.needed(None)) == {"one", "two", "three", "four"}
