"""`why` says which field of dataset.yaml changed, what it was and what it is, and what a default is."""

import json

import hypothesis.strategies as st
import pytest
import yaml
from hypothesis import given, settings

from factorlib.dataset.slices import _fields
from factorlib.runner import verbs, words
from factorlib.runner.plan import Listing, plan
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.runner.survey import survey
from tests.runner import toy
from tests.runner.toy import reasons, write

FILES = ["kitchen.jpg", "hall.jpg", "mask.png", "own.png", "chair.obj", "vase.ply"]
SET = {
    "format": 1,
    "materials": ["red", "white"],
    "meshes": {
        "chair": {"file": "chair.obj", "parts": {"shell": "red", "legs": "white"}},
        "vase": {"file": "vase.ply", "material": "white"},
    },
    "photos": [
        {"name": "kitchen", "image": "kitchen.jpg", "masks": "mask.png", "objects": [{"name": "c", "mesh": "chair"}]},
        {
            "name": "hall",
            "image": "hall.jpg",
            "masks": {"red": "mask.png"},
            "objects": [{"name": "c", "mesh": "chair"}, {"name": "v", "mesh": "vase"}],
        },
    ],
}


class Everything(dict):
    """A store that holds a result of every key."""

    def get(self, key, default=None):
        return f"output of {key}"


@pytest.fixture
def project(tmp_path):
    for name in ("pipeline.yaml", "stages", "factorlib"):
        (tmp_path / name).symlink_to(LIBRARY / name)
    for name in FILES:
        write(tmp_path / "data" / "set" / name, "")
    (tmp_path / "data" / "set" / "dataset.yaml").write_text(yaml.safe_dump(SET))
    return Project(tmp_path, photo_sets())


def why(project, change, settings=(), before=()):
    """What `make why` would print if all had been made, then dataset.yaml changed."""
    seen = survey(project, "set", None, list(before))
    made = plan(seen.spec, seen.records, Listing(Everything(), {}))
    spec = json.loads(json.dumps(SET))
    change(spec)
    write(project.root / "data" / "set" / "dataset.yaml", yaml.safe_dump(spec))
    seen = survey(project, "set", None, list(settings))
    listing = Listing({p.key: p.output for p in made}, {str(p.step): p.record for p in made})
    return "\n".join(words.why_lines(plan(seen.spec, seen.records, listing)))


@pytest.mark.parametrize(
    "place, key, value, line",
    [
        (("photos", 0), "encoding", "linear", 'dataset.yaml: photos.*.encoding: not given -> "linear"'),
        (("photos", 0), "camera", {"focal_px": 812.0}, "dataset.yaml: photos.*.camera.focal_px: not given -> 812.0"),
        (("photos", 0), "illumination", "hall", 'dataset.yaml: photos.*.illumination: "kitchen" -> "hall"'),
        (("photos", 0), "masks", "own.png", 'dataset.yaml: photos.*.masks: "mask.png" -> "own.png"'),
        (
            ("photos", 1, "objects", 1),
            "mask",
            "own.png",
            'dataset.yaml: photos.*.objects[1].mask: not given -> "own.png"',
        ),
        (
            ("photos", 1, "objects", 0),
            "materials",
            {"legs": "red"},
            'photos.*.objects[0].materials.legs: not given -> "red"',
        ),
        (("meshes", "chair", "parts"), "legs", "red", 'dataset.yaml: meshes.chair.parts.legs: "white" -> "red"'),
        ((), "materials", ["red", "white", "wood"], "dataset.yaml: materials: 'wood' came"),
        ((), "materials", ["white", "red"], 'dataset.yaml: materials: ["red", "white"] -> ["white", "red"]'),
    ],
)
def test_the_field_is_named_with_old_and_new(project, place, key, value, line):
    def change(spec):
        for step in place:
            spec = spec[step]
        spec[key] = value

    said = why(project, change)
    assert line in said and "changed" not in said.replace("file ", "")


def test_a_step_over_the_whole_set_names_the_photo(project):
    said = why(project, lambda spec: spec["photos"][0].update(illumination="one"))
    assert 'photos.kitchen.illumination: "kitchen" -> "one"' in said.split("solve")[1]


def test_a_parameter_names_its_default_and_its_value(project):
    unchanged = lambda spec: None  # noqa: E731
    assert "parameter lobes: 72 (the default) -> 48" in why(project, unchanged, settings=["solve.lobes=48"])
    assert "parameter lobes: 48 -> 72 (the default)" in why(project, unchanged, before=["solve.lobes=48"])


def test_a_default_that_changes_is_named(tmp_path):
    project = toy.make_project(tmp_path)
    assert verbs.make(project, verbs.Wish("set", ["table"])) == 0
    write(project.root / "stages" / "table.py", toy.TABLE.replace("scale: int = 2", "scale: int = 3"))
    assert reasons(project, "table") == ["default of parameter scale: 2 -> 3", "source of stages.table: changed"]


def test_what_changed_in_every_photo_is_said_once(project):
    def change(spec):
        for photo in spec["photos"]:
            photo["encoding"] = "linear"

    assert why(project, change).count("encoding") == 1


names = st.text("ab", min_size=1, max_size=2)
facts = st.recursive(
    st.none() | st.booleans() | st.integers(0, 2) | names | st.lists(st.integers(0, 2), max_size=2),
    lambda inner: (
        st.dictionaries(names, inner, max_size=2) | st.lists(st.dictionaries(names, inner, max_size=2), max_size=2)
    ),
    max_leaves=6,
)


@settings(max_examples=300)
@given(facts, facts)
def test_fields_are_equal_just_where_the_facts_are(one, other):
    """They stand in the key in place of the facts."""
    assert (json.dumps(_fields(one, "x"), sort_keys=True) == json.dumps(_fields(other, "x"), sort_keys=True)) == (
        json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)
    )
