"""What a step can read counts in its key, is looked at again before its result is kept, and is named by `why`."""

import ast
import json

import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import given, settings

from factorlib.dataset.slices import _fields
from factorlib.errors import InputError
from factorlib.runner import words
from factorlib.runner.plan import Listing, plan
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.runner.survey import survey
from tests.faults.battered import make
from tests.faults.test_many_photos import Everything
from tests.runner import toy
from tests.runner.toy import reasons, state, write

# ── what changes while a step runs ───────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def fresh(tmp_path):
    """The toy, nothing made yet."""
    return toy.make_project(tmp_path / "root")


def doing(stage, code):
    """The text of a stage that runs some code before it writes."""
    return stage.replace("(out /", f"{code}\n    (out /", 1).replace(
        "import json", "import json\nfrom pathlib import Path", 1
    )


def editing(stage, file, content):
    """A stage that writes to a file while it runs, as an editor beside it would."""
    return doing(stage, f"Path({str(file)!r}).write_text({content!r})")


EDITS = {
    "stages/table.py": toy.TABLE.replace("params.scale", "7"),
    "stages/table.py, half typed": "def (",
    "toylib/more.py": "NUMBER = 2\n",
    "stages/note.txt": "other",
}


@pytest.mark.parametrize("edit", EDITS)
def test_code_or_package_data_edited_while_a_step_runs_is_not_kept_under_the_old_key(fresh, capsys, edit):
    file = edit.partition(",")[0]
    write(fresh.root / "toylib" / "more.py", "NUMBER = 1\n")
    write(fresh.root / "stages" / "note.txt", "one")
    source = toy.TABLE.replace("import msgspec", "import msgspec\nfrom toylib import more")
    write(fresh.root / "stages" / "table.py", editing(source, fresh.root / file, EDITS[edit]))
    assert make(fresh, targets=["table"]) == 1
    text = capsys.readouterr().err
    assert file in text and "defect" not in text
    assert edit != file or ("changed while" in text and "run again" in text)
    assert not list((fresh.build / "store").glob("keys/*")) and not list((fresh.build / "store").glob("trees/*"))


def test_a_stage_whose_code_was_edited_is_not_started_for_further_photos(fresh, capsys, monkeypatch):
    monkeypatch.setattr("factorlib.runner.child.machine_cores", lambda: 1)
    path = fresh.root / "stages" / "count.py"
    write(path, editing(toy.COUNT, path, toy.COUNT + "\nMORE = 1\n"))
    assert make(fresh) == 1
    text = capsys.readouterr()
    assert text.err.count("changed while the run went on") == 1
    assert "1 step failed: count/a" in text.out and "not run for that: count" in text.out


def test_a_remark_typed_while_a_step_runs_loses_nothing(fresh):
    path = fresh.root / "stages" / "table.py"
    write(path, doing(toy.TABLE, f"f = Path({str(path)!r}); f.write_text('# a remark\\n' + f.read_text())"))
    assert make(fresh, targets=["table"]) == 0 and path.read_text().startswith("# a remark")


def test_code_edited_before_its_step_begins_stops_it_before_it_costs_anything(fresh, capsys):
    """The table edits a stage that comes after it."""
    later, sign = fresh.root / "stages" / "total.py", fresh.root / "it-ran"
    text = toy.TOTAL.replace("counts =", f"Path({str(sign)!r}).touch()\n    counts =")
    write(later, text)
    write(fresh.root / "stages" / "table.py", editing(toy.TABLE, later, text.replace("str(scale", "str(2 * scale")))
    assert make(fresh) == 1
    assert "stages/total.py" in capsys.readouterr().err and not sign.exists()
    assert make(fresh) == 0 and (fresh.build / "set" / "total" / "total.txt").read_text() == "total: 36"


# ── what counts ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_every_file_in_the_package_of_a_module_counts_but_what_python_or_an_editor_leaves(project):
    counting, other = (
        ["kernel.c", "table", "weights/w.json", "README.md", "lib.so"],
        [".letters.py.swp", "letters.py~", "#letters.py#"],
    )
    other += [".hidden/x.c", "__pycache__/letters.cpython-311.pyc", "letters.pyc"]
    for name in other:
        write(project.root / "toylib" / name, "1")
        assert set(state(project).values()) == {"current"}, name
    for name in counting:
        write(project.root / "toylib" / name, "1")
    assert make(project) == 0
    for name in counting:
        write(project.root / "toylib" / name, "2")
        assert reasons(project, "count/a") == [f"package data toylib:{name}: changed"]
        (project.root / "toylib" / name).unlink()
        assert reasons(project, "count/a") == [f"package data toylib:{name}: gone"]
        write(project.root / "toylib" / name, "1")


def test_no_module_is_named_only_at_run_time():
    """`import_module(name)` hides a module from the keys of the steps that run it; the runner alone loads stages so.

    The package's own `__init__` hides `load_result` from every stage on purpose: no stage calls it.
    """
    loaders = ("import_module", "__import__", "run_path", "run_module", "spec_from_file_location")
    package = LIBRARY / "factorlib"
    files = {p for folder in (package, LIBRARY / "stages") for p in folder.rglob("*.py")} - {package / "__init__.py"}
    hidden = [
        f"{path}: {name}"
        for path in files
        if package / "runner" not in path.parents
        for node in ast.walk(ast.parse(path.read_text()))
        if (name := getattr(node, "id", getattr(node, "attr", ""))) in loaders
    ]
    assert not hidden and not [p for p in (LIBRARY / "stages").glob("*.py") if "load_result" in p.read_text()]


SPEAKING = 'import os\nENVIRONMENT = ("TOY_FORM",)\nPROGRAMS = {"TOY_CC": "sh"}\ndef letters(text):\n    return len(text) if os.environ.get("TOY_FORM") == "0" else 1\n'


@pytest.fixture
def speaking(fresh, monkeypatch):
    """The toy whose letters depend on the environment, and say so."""
    for name in ("TOY_FORM", "TOY_CC"):
        monkeypatch.delenv(name, raising=False)
    write(fresh.root / "toylib" / "letters.py", SPEAKING)
    assert make(fresh) == 0
    return fresh


def test_an_environment_variable_that_a_module_declares_is_in_the_key(speaking, monkeypatch):
    total = speaking.build / "set" / "total" / "total.txt"
    assert total.read_text() == "total: 4"
    monkeypatch.setenv("TOY_FORM", "0")
    assert reasons(speaking, "count/a") == ['environment variable TOY_FORM: none -> "0"']
    assert state(speaking)["upper/a"] == "current", "only what runs that module"
    assert make(speaking) == 0 and total.read_text() == "total: 18"
    monkeypatch.delenv("TOY_FORM")
    assert set(state(speaking).values()) == {"current"}, "the other form's results are still there"


def test_whether_a_program_that_a_module_declares_is_there_is_in_the_key(speaking, monkeypatch):
    monkeypatch.setenv("TOY_CC", "no-such-program")
    assert reasons(speaking, "count/a") == ['program TOY_CC: "sh" -> none']
    monkeypatch.setenv("TOY_CC", "/bin/sh")
    assert set(state(speaking).values()) == {"current"}, "where it lies is no matter"
    monkeypatch.setenv("TOY_CC", "sh 'open")
    with pytest.raises(InputError, match="is no command") as caught:
        state(speaking)
    assert caught.value.key == "TOY_CC"
    write(speaking.root / "toylib" / "letters.py", SPEAKING.replace('("TOY_FORM",)', 'tuple(["TOY_FORM"])'))
    with pytest.raises(InputError, match=r"(?s)letters\.py.*ENVIRONMENT"):
        state(speaking)


# ── why ──────────────────────────────────────────────────────────────────────────────────────────────────────────────

CHAIR = {"file": "chair.obj", "parts": {"shell": "red", "legs": "white"}}
KITCHEN = {"name": "kitchen", "image": "kitchen.jpg", "masks": "mask.png", "objects": [{"name": "c", "mesh": "chair"}]}
HALL = {
    "name": "hall",
    "image": "hall.jpg",
    "masks": {"red": "mask.png"},
    "objects": [*KITCHEN["objects"], {"name": "v", "mesh": "vase"}],
}
MESHES = {"chair": CHAIR, "vase": {"file": "vase.ply", "material": "white"}}
SET = {"format": 1, "materials": ["red", "white"], "meshes": MESHES, "photos": [KITCHEN, HALL]}


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """This project with a data set of its own, whose files are empty."""
    tmp_path = tmp_path_factory.mktemp("photos")
    for name in ("pipeline.yaml", "stages", "factorlib"):
        (tmp_path / name).symlink_to(LIBRARY / name)
    for name in ["kitchen.jpg", "hall.jpg", "mask.png", "own.png", "chair.obj", "vase.ply"]:
        write(tmp_path / "data" / "set" / name, "")
    return Project(tmp_path, photo_sets())


def why(project, change=lambda spec: None, settings=(), before=()):
    """What `make why` would print if all had been made, then dataset.yaml changed."""
    file = project.root / "data" / "set" / "dataset.yaml"
    write(file, yaml.safe_dump(SET))
    seen = survey(project, "set", None, list(before))
    made = plan(seen.spec, seen.records, Listing(Everything(), {}))
    spec = json.loads(json.dumps(SET))
    change(spec)
    write(file, yaml.safe_dump(spec))
    seen = survey(project, "set", None, list(settings))
    listing = Listing({p.key: p.output for p in made}, {str(p.step): p.record for p in made})
    return "\n".join(words.why_lines(plan(seen.spec, seen.records, listing)))


KITCHEN_, HALL_ = ("photos", 0), ("photos", 1, "objects")


@pytest.mark.parametrize("place, key, value, line", [
    (KITCHEN_, "encoding", "linear", 'dataset.yaml: photos.*.encoding: not given -> "linear"'),
    (KITCHEN_, "camera", {"focal_px": 812.0}, "dataset.yaml: photos.*.camera.focal_px: not given -> 812.0"),
    (KITCHEN_, "illumination", "hall", 'dataset.yaml: photos.*.illumination: "kitchen" -> "hall"'),
    (KITCHEN_, "masks", "own.png", 'dataset.yaml: photos.*.masks: "mask.png" -> "own.png"'),
    ((*HALL_, 1), "mask", "own.png", 'dataset.yaml: photos.*.objects[1].mask: not given -> "own.png"'),
    ((*HALL_, 0), "materials", {"legs": "red"}, 'photos.*.objects[0].materials.legs: not given -> "red"'),
    (("meshes", "chair", "parts"), "legs", "red", 'dataset.yaml: meshes.chair.parts.legs: "white" -> "red"'),
    ((), "materials", ["red", "white", "wood"], "dataset.yaml: materials: 'wood' came"),
    ((), "materials", ["white", "red"], 'dataset.yaml: materials: ["red", "white"] -> ["white", "red"]'),
])  # fmt: skip
def test_the_field_is_named_with_old_and_new(photos, place, key, value, line):
    def change(spec):
        for step in place:
            spec = spec[step]
        spec[key] = value

    text = why(photos, change)
    assert line in text and "changed" not in text.replace("file ", "")


def test_a_step_over_the_set_names_the_photo_and_what_changed_in_every_photo_is_said_once(photos):
    text = why(photos, lambda spec: spec["photos"][0].update(illumination="one"))
    assert 'photos.kitchen.illumination: "kitchen" -> "one"' in text.split("solve")[1]
    text = why(photos, lambda spec: [photo.update(encoding="linear") for photo in spec["photos"]])
    assert text.count("encoding") == 1


def test_a_parameter_and_a_changed_default_name_what_they_were_and_are(photos, project):
    assert "parameter lobes: 72 (the default) -> 48" in why(photos, settings=["solve.lobes=48"])
    assert "parameter lobes: 48 -> 72 (the default)" in why(photos, before=["solve.lobes=48"])
    write(project.root / "stages" / "table.py", toy.TABLE.replace("scale: int = 2", "scale: int = 3"))
    assert reasons(project, "table") == ["default of parameter scale: 2 -> 3", "source of stages.table: changed"]


def test_a_default_that_the_source_does_not_tell_for_certain_is_no_default(project):
    """A key that is too new costs time; one that is too old would give the result of another parameter."""
    uncertain = toy.TABLE.replace("class Params", "GAIN = 1\nif msgspec:\n    GAIN = 2\nclass Params", 1)
    write(project.root / "stages" / "table.py", uncertain.replace("scale: int = 2", "scale: int = GAIN"))
    assert make(project) == 0 and (project.build / "set" / "total" / "total.txt").read_text() == "total: 18"
    assert {state(project, settings=(f"table.scale={scale}",))["table"] for scale in (1, 2)} == {"to run"}


names = st.text("ab", min_size=1, max_size=2)
tables = lambda inner: st.dictionaries(names, inner, max_size=2)  # noqa: E731
facts = st.recursive(
    st.none() | st.booleans() | st.integers(0, 2) | names | st.lists(st.integers(0, 2), max_size=2),
    lambda inner: tables(inner) | st.lists(tables(inner), max_size=2),
    max_leaves=6,
)


@settings(max_examples=100)
@given(facts, facts)
def test_fields_are_equal_just_where_the_facts_are(one, other):
    """They stand in the key in place of the facts."""
    text = lambda value: json.dumps(value, sort_keys=True)  # noqa: E731
    assert (text(_fields(one, "x")) == text(_fields(other, "x"))) == (text(one) == text(other))
