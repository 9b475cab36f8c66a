"""Which steps get new keys by a single change: exactly those that the change can reach, and those below them; `why` names it.

Of a copy of this project, at the level of plans: files are edited, nothing is run.  What a stage imports another library
says, too (grimp, of import-linter).
"""

import contextlib
import os
from functools import cache

import grimp
import pytest
import yaml

from factorlib.runner import verbs
from factorlib.runner.closure import Sources
from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.plan import Listing, plan
from factorlib.runner.project import LIBRARY, photo_sets, read_pipeline
from factorlib.runner.store import FileHashes
from tests.faults.sample import edited as edited_data
from tests.refusal import refusal
from tests.runner import toy
from tests.runner.toy import make, real_project, reasons, state, write

PIPELINE = read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices).for_data(lambda _: True)
STAGES = list(PIPELINE.stages)


class Everything(dict):
    """A store that holds a result of every key, another for each."""

    def get(self, key, default=None):
        return f"output of {key}"


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """This project, to be edited."""
    return real_project(tmp_path_factory.mktemp("project"), "pipeline.yaml", "stages", "factorlib", "data", "recipes")


def planned(project, settings=(), held_out=()):
    """Every step, those of optional stages and of all recipes too, as planned were everything made."""
    state = read_state(project, Request("synthetic", STAGES, settings, recipes=["all"], held_out=held_out))
    return plan(state.spec, state.records, Listing(Everything(), {}))


def keys(project, settings=(), held_out=()):
    return {str(p.step): p.key for p in planned(project, settings, held_out)}


@cache
def usual(project):
    return keys(project)


@contextlib.contextmanager
def edited(project, name: str, content: bytes):
    """Within, a file of the project holds something else."""
    before = (project.root / name).read_bytes()
    usual(project)
    try:
        (project.root / name).write_bytes(content)
        yield
    finally:
        (project.root / name).write_bytes(before)


@cache
def imports():
    """What imports what; a module also imports the packages above it, which Python runs first."""
    graph = grimp.build_graph("factorlib", "stages", cache_dir=None)
    for name in (name for name in graph.modules if "." in name):
        graph.add_import(importer=name, imported=name.rpartition(".")[0])
    return graph


@pytest.mark.parametrize("stage", STAGES)
def test_the_sources_in_a_key_are_all_that_another_library_finds_imported_and_no_others(stage):
    record = Sources([LIBRARY], FileHashes(None)).closure("stages", stage, LIBRARY / "pipeline.yaml").record
    modules = {name.removeprefix("source:") for name in record if name.startswith("source:")}
    assert modules == {f"stages.{stage}", *imports().find_upstream_modules(f"stages.{stage}")}
    assert "factorlib.stage" in modules and not any(name.startswith("factorlib.runner") for name in modules)


def test_a_photo_held_out_for_one_run_has_the_keys_of_one_that_the_dataset_holds_out_and_spares_what_it_cannot_reach(
    real,
):
    spec = yaml.safe_load((real.root / "data/synthetic/dataset.yaml").read_text())
    first, *others = [photo["name"] for photo in spec["photos"]]
    held_out = keys(real, held_out=[f"{first},"])
    spared = {step for step in usual(real) if step.partition("/")[0] in ("masks", "shapes", "align", "train")}
    spared |= {f"urm/{photo}" for photo in others}
    assert {step for step, key in usual(real).items() if held_out[step] == key} == spared
    spec["photos"][0]["held_out"] = True
    with edited(real, "data/synthetic/dataset.yaml", yaml.safe_dump(spec).encode()):
        assert keys(real) == held_out


def test_an_edit_that_keeps_size_and_time_is_noticed(real):
    """Of a file of the data set, of a module and of a file of a package; all are old enough to be remembered."""
    for name, old, new in (
        ("data/synthetic/masks/study.png", b"IEND", b"IENE"),
        ("factorlib/urm/reduction.py", b"return ", b"return-"),
        ("factorlib/reflection/kernel.c", b"int ", b"long"),
    ):
        path, before = real.root / name, (real.root / name).read_bytes()
        os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns - 10**10))
        known, stat = keys(real), path.stat()
        with edited(real, name, before.replace(old, new, 1)):
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            assert (path.stat().st_size, path.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
            assert keys(real) != known, name
    assert keys(real) == usual(real)


# ── what else counts ─────────────────────────────────────────────────────────────────────────────────────────────────


SPEAKING = 'import os\nENVIRONMENT = ("TOY_FORM",)\nPROGRAMS = {"TOY_CC": "sh"}\ndef letters(text):\n    return len(text) if os.environ.get("TOY_FORM") == "0" else 1\n'


def test_an_environment_variable_and_a_program_that_a_module_declares_are_in_the_key(fresh, monkeypatch):
    monkeypatch.delenv("TOY_FORM", raising=False), monkeypatch.delenv("TOY_CC", raising=False)
    letters, total = fresh.root / "toylib" / "letters.py", fresh.build / "set" / "total" / "total.txt"
    write(letters, SPEAKING)
    assert make(fresh) == 0 and total.read_text() == "total: 4"
    monkeypatch.setenv("TOY_FORM", "0")
    assert reasons(fresh, "count/a") == ['environment variable TOY_FORM: none -> "0"']
    assert state(fresh)["upper/a"] == "current", "only what runs that module"
    assert make(fresh) == 0 and total.read_text() == "total: 18"
    monkeypatch.delenv("TOY_FORM")
    assert set(state(fresh).values()) == {"current"}, "the other form's results are still there"
    monkeypatch.setenv("TOY_CC", "no-such-program")
    assert 'program TOY_CC: "sh" -> none' in reasons(fresh, "count/a")
    monkeypatch.setenv("TOY_CC", "/bin/sh")
    assert set(state(fresh).values()) == {"current"}, "where it lies is no matter"
    write(letters, SPEAKING.replace('("TOY_FORM",)', 'tuple(["TOY_FORM"])'))
    refusal(r"(?s)letters\.py.*ENVIRONMENT", state, fresh)


# ── why ──────────────────────────────────────────────────────────────────────────────────────────────────────────────

CHAIR = {"file": "chair.obj", "parts": {"shell": "red", "legs": "white"}}
C, V = {"name": "c", "mesh": "chair"}, {"name": "v", "mesh": "vase"}
KITCHEN = {"name": "kitchen", "image": "kitchen.jpg", "masks": "mask.png", "objects": [C]}
HALL = {"name": "hall", "image": "hall.jpg", "masks": {"red": "mask.png"}, "objects": [C, V]}
MESHES = {"chair": CHAIR, "vase": {"file": "vase.ply", "material": "white"}}
SET = {"format": 1, "materials": ["red", "white"], "meshes": MESHES, "photos": [KITCHEN, HALL]}
FIELDS = [  # where something is set, and the line that says so
    ("photos.0.encoding", "linear", 'dataset.yaml: photos.*.encoding: not given -> "linear"'),
    ("photos.0.camera", {"focal_px": 812.0}, "dataset.yaml: photos.*.camera.focal_px: not given -> 812.0"),
    ("photos.0.illumination", "hall", 'dataset.yaml: photos.*.illumination: "kitchen" -> "hall"'),
    ("photos.0.illumination", "one", 'photos.kitchen.illumination: "kitchen" -> "one"'),
    ("photos.0.masks", "own.png", 'dataset.yaml: photos.*.masks: "mask.png" -> "own.png"'),
    ("photos.1.objects.1.mask", "own.png", 'dataset.yaml: photos.*.objects[1].mask: not given -> "own.png"'),
    ("photos.1.objects.0.materials", {"legs": "red"}, 'photos.*.objects[0].materials.legs: not given -> "red"'),
    ("meshes.chair.parts.legs", "red", 'dataset.yaml: meshes.chair.parts.legs: "white" -> "red"'),
    ("materials", ["red", "white", "wood"], 'dataset.yaml: materials: ["red", "white"] -> ["red", "white", "wood"]'),
    ("materials", ["white", "red"], 'dataset.yaml: materials: ["red", "white"] -> ["white", "red"]'),
]  # fmt: skip


def test_the_field_and_the_parameter_that_changed_are_named_with_old_and_new(real, project, tmp_path):
    """As `make why` would print, if all had been made, then dataset.yaml changed."""
    for name in ("kitchen.jpg", "hall.jpg", "mask.png", "own.png", "chair.obj", "vase.ply"):
        write(tmp_path / "set" / name, "")

    def planned_with(spec=SET, settings=(), planned=()):
        write(tmp_path / "set" / "dataset.yaml", yaml.safe_dump(spec))
        result = read_state(real, Request(str(tmp_path / "set"), settings=settings))
        listing = Listing({p.key: p.output for p in planned}, {str(p.step): p.record for p in planned})
        return plan(result.spec, result.records, listing if planned else Listing(Everything(), {}))

    def why(planned, spec=SET, settings=()):
        return "\n".join(verbs.plan_lines(planned_with(spec, settings, planned), True))

    planned, lobes = planned_with(), ["solve.lobes=48"]
    for place, value, line in FIELDS:
        text = why(planned, edited_data(SET, *(int(w) if w.isdigit() else w for w in place.split(".")), value=value))
        assert line in text and "changed" not in text.replace("file ", "")
    linear = edited_data(SET, "photos", value=[photo | {"encoding": "linear"} for photo in SET["photos"]])
    assert why(planned, linear).count("encoding") == 1, "what changed in every photo is said once"
    assert "parameter lobes: default -> 48" in why(planned, settings=lobes)
    assert "parameter lobes: 48 -> default" in why(planned_with(settings=lobes))
    write(project.root / "stages" / "table.py", toy.TABLE.replace("scale: int = 2", "scale: int = 3"))
    assert reasons(project, "table") == ["source of stages.table: changed"]
