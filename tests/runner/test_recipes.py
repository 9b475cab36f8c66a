"""A stage over recipes: a step for each that is asked for, its pictures under the recipe's name, and nothing else rerun for it."""

import json
from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.project import Project, Provider, Recipe
from factorlib.runner.results_folder import all_results, clean
from tests.runner import toy
from tests.runner.toy import write

SHOUT = """
import msgspec
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    mark: str = "!"
def main(params, inputs, out, progress):
    recipe = inputs.facts["recipe"]
    more = inputs.file("recipe file:" + recipe["file"]).read_text() if recipe.get("file") else ""
    photos = sorted(path.stem for path in inputs["upper"].glob("*.txt"))
    (out / "said.txt").write_text(recipe["word"] + params.mark + more + "".join(photos))
"""
LOOKED_AT = []
OVER_RECIPES = '  shout: {inputs: [upper], over: recipe, optional: true, makes: ["said.txt"]}\n'


def reading(path: Path) -> Recipe:
    output = json.loads(path.read_text())
    if "fault" in output:
        raise InputError(output["fault"], file=path)
    return Recipe(output, {output["file"]: path.parent / output["file"]} if output.get("file") else {})


@pytest.fixture
def project(tmp_path):
    made = toy.make_project(tmp_path / "root")
    write(made.root / "stages" / "shout.py", SHOUT)
    write(made.pipeline_file, toy.PIPELINE + OVER_RECIPES)
    write(made.root / "recipes" / "hello.yaml", '{"word": "hello"}')
    write(made.root / "recipes" / "set" / "bye.yaml", '{"word": "bye", "file": "more.txt"}')
    write(made.root / "recipes" / "set" / "more.txt", "…")
    write(made.root / "recipes" / "other" / "not.yaml", '{"word": "not for this set"}')

    def read(folder, held_out=()):
        data = toy.read(folder)

        def faults(files):
            LOOKED_AT.extend(files)
            return [InputError("a fault", file=path) for path in files.values() if "fault" in path.read_text()]

        return type(data)(data.folder, data.photos, data.slice, recipe=reading, recipe_faults=faults)

    LOOKED_AT.clear()
    return Project(made.root, Provider(("photo",), read))


def said(project, recipe):
    return (project.build / "set" / "shout" / recipe / "said.txt").read_text()


def to_run(project, *recipes, targets=("shout",)):
    state = read_state(project, Request("set", list(targets), recipes=recipes))
    return [str(p.step) for p in state.plan() if p.status != "current"]


def make(project, *recipes, targets=("render",), **more):
    return verbs.make(project, verbs.Request("set", targets and list(targets), recipes=list(recipes), **more))


def test_every_recipe_is_a_step_with_a_folder_of_its_own_all_where_none_is_named_a_path_as_well(project, monkeypatch):
    write(project.root / "mine" / "own.yaml", '{"word": "own"}')
    monkeypatch.chdir(project.root)
    assert make(project, "mine/own.yaml") == 0 and said(project, "own") == "own!ab"
    assert make(project, "hello") == 0 and said(project, "hello") == "hello!ab"
    assert not (project.build / "set" / "total").exists()  # what no recipe takes did not run
    assert make(project, targets=["shout"]) == 0 and said(project, "bye") == "bye!…ab"


def test_what_was_asked_for_before_stays_until_it_is_cleaned(project):
    assert make(project, "hello") == 0 and make(project, "bye") == 0
    assert said(project, "hello") and said(project, "bye") and to_run(project, "all") == []
    assert verbs.make(project, verbs.Request("set")) == 0  # without recipes
    assert said(project, "hello") and to_run(project, "all") == []
    clean(project, "set")
    assert all_results(project) == [] and not (project.build / "set").exists()


def test_a_recipe_reruns_for_what_it_says_and_for_its_files_and_alone(project):
    assert make(project, "all") == 0
    write(project.root / "recipes" / "hello.yaml", '{ "word":   "hello" }')
    assert to_run(project, "all") == []
    write(project.root / "recipes" / "hello.yaml", '{"word": "hi"}')
    assert to_run(project, "all") == ["shout/hello"]
    write(project.root / "recipes" / "set" / "more.txt", "and more")
    reasons = [p.reasons for p in read_state(project, Request("set", ["shout"], recipes=["all"])).plan()[-2:]]
    assert reasons == [['recipe: word: "hello" -> "hi"'], ["file more.txt of the recipe: changed"]]
    assert make(project, "all") == 0
    toy.edit(project, "pipeline.yaml", "gather: sizes.json", "gather: all.json")
    reasons = [p.reasons for p in read_state(project, Request("set", ["shout"], recipes=["hello"])).plan()[-1:]]
    assert reasons == [['gathered file of upper: "sizes.json" -> "all.json"']]


def test_files_of_a_recipe_are_looked_at_before_anything_runs_and_only_those_of_steps_that_run(project, capsys):
    more = project.root / "recipes" / "set" / "more.txt"
    write(more, "a fault")
    assert make(project, "all") == 1 and "a fault" in capsys.readouterr().err
    assert not (project.build / "set").exists()
    write(more, "…")
    assert make(project, "all") == 0
    LOOKED_AT.clear()
    assert make(project, "all") == 0 and make(project, "all", settings=["shout.mark=x"]) == 0
    assert said(project, "bye") == "byex…ab" and LOOKED_AT == ["more.txt"]
    LOOKED_AT.clear()
    write(more, "another fault")
    assert make(project, "all") == 1 and LOOKED_AT == ["more.txt"]


def test_all_leaves_out_a_recipe_for_every_set_that_does_not_suit_this_one_and_one_of_the_sets_own_is_refused(
    project, caplog
):
    data = project.provider.read(project.root / "data" / "set")
    write(project.root / "recipes" / "odd.yaml", '{"fault": "one light"}')
    assert list(project.recipes(data, ["all"])) == ["hello", "bye"] and "leaves out odd" in caplog.text
    for words in (["odd"], ["all"]):
        with pytest.raises(InputError, match="one light"):
            project.recipes(data, words)
        write(project.root / "recipes" / "set" / "odd.yaml", '{"fault": "one light"}')


@pytest.mark.parametrize(
    "words, wrong",
    [
        (["helo"], "did you mean 'hello'"),
        (["recipes/helo.yaml"], "did you mean 'hello'"),
        (["not"], "known are"),
        (["hello", "{}/hello.yaml"], "two recipes are called 'hello'"),
        (["{}/" + "x" * 240 + ".yaml"], "rename it"),
        (["{}/two\nlines.yaml"], "rename it"),
    ],
    ids=["a name", "a path", "of another set", "two of one name", "a long name", "two lines"],
)
def test_a_recipe_that_is_not_there_or_can_have_no_folder_is_refused(project, tmp_path, words, wrong):
    for name in ("hello", "x" * 240, "two\nlines"):
        write(tmp_path / f"{name}.yaml", '{"word": "own"}')
    with pytest.raises(InputError) as error:
        project.recipes(project.provider.read(project.root / "data" / "set"), [w.format(tmp_path) for w in words])
    assert wrong in str(error.value)
