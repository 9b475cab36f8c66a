"""The drawing of the graph: every stage once, every arrow to the right, nothing on top of something else."""

import re
from itertools import combinations
from xml.etree import ElementTree

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from factorlib.runner import verbs
from factorlib.runner.drawing import HEIGHT, WIDTH, State, drawing, layers_of
from factorlib.runner.pipeline import Pipeline, Stage, read_pipeline
from factorlib.runner.project import LIBRARY, photo_sets
from tests.runner.toy import make_project

SVG = "{http://www.w3.org/2000/svg}"


@st.composite
def pipelines(draw):
    """Some stages, each taking some of those before it."""
    names = [f"s{k}" for k in range(draw(st.integers(1, 8)))]
    taken = [draw(st.lists(st.sampled_from(names[:k]), unique=True)) if k else [] for k in range(len(names))]
    over = [draw(st.sampled_from([None, "photo"])) for _ in names]
    return Pipeline(1, {name: Stage(inputs=inputs, over=each) for name, inputs, each in zip(names, taken, over)})


def boxes(tree):
    """Left and top edge of each stage, by its name."""
    groups = list(tree.iter(f"{SVG}g"))
    rect = {group.find(f"{SVG}text").text: group.find(f"{SVG}rect") for group in groups}
    assert len(rect) == len(groups), "a stage stands there twice"
    return {name: (float(found.get("x")), float(found.get("y"))) for name, found in rect.items()}


def check(pipeline):
    tree = ElementTree.fromstring(drawing(pipeline))
    at, layers = boxes(tree), layers_of(pipeline)
    arrows = [path.get("d") for path in tree.iter(f"{SVG}path") if path.get("d").startswith("M") and "C" in path.get("d")]
    assert at.keys() == pipeline.stages.keys()
    assert len(arrows) == sum(len(stage.upstream) for stage in pipeline.stages.values())
    for one, other in combinations(at.values(), 2):
        assert abs(one[0] - other[0]) >= WIDTH or abs(one[1] - other[1]) >= HEIGHT, "two stages overlap"
    for name, stage in pipeline.stages.items():
        assert all(at[above][0] + WIDTH < at[name][0] and layers[above] < layers[name] for above in stage.upstream)
    for arrow in arrows:
        x = [float(word.split(",")[0]) for word in re.findall(r"[-\d.]+,[-\d.]+", arrow)]
        assert x == sorted(x), "an arrow leads back"
    return at, arrows


@given(pipelines())
@settings(deadline=None, max_examples=60)
def test_any_graph(pipeline):
    check(pipeline)


def test_the_pipeline_of_this_project():
    at, arrows = check(read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices))
    for name, (x, y) in at.items():  # no arrow crosses a box that it does not lead to or from
        for arrow in arrows:
            inner = [(float(a), float(b)) for a, b in re.findall(r"([-\d.]+),([-\d.]+)", arrow)]
            assert not any(x + 1 < a < x + WIDTH - 1 and y + 1 < b < y + HEIGHT - 1 for a, b in inner), name


def test_it_says_how_far_each_stage_is():
    pipeline = Pipeline(1, {"a": Stage(over="photo"), "b": Stage(inputs=["a"])})
    svg = drawing(pipeline, {"a": State(7, {"current": 5, "to run": 2}), "b": State(1, {"maybe": 1})})
    assert "7 photos" in svg and "5 current, 2 to run" in svg and "1 maybe" in svg
    assert "per photo" in drawing(pipeline) and "whole set" in svg


def test_the_verb_draws_a_data_set(tmp_path, capsys):
    project = make_project(tmp_path / "root")
    assert verbs.show_graph(project, svg=tmp_path / "new" / "g.svg", wish=verbs.Wish("set")) == 0
    assert "2 to run" in (tmp_path / "new" / "g.svg").read_text() and "g.svg" in capsys.readouterr().out
    with pytest.raises(verbs.InputError, match="no name of an SVG"):
        verbs.show_graph(project, svg=tmp_path / "g.png")
