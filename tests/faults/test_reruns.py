"""Which steps get new keys by a single change: exactly those that the change can reach, and those below them; `why` names it.

Of a copy of this project, at the level of plans: files are edited, nothing is run.  Who can be reached by a change of
code another library says (grimp, of import-linter), who by a file of a data set, dataset.yaml.  `make test` takes a sample
that is the same each time, `make test-long` every module, file and package.
"""

from __future__ import annotations

import ast
import contextlib
import importlib.metadata
import json
import os
import random
from functools import cache
from importlib.metadata import packages_distributions
from itertools import islice
from pathlib import Path

import grimp
import msgspec
import pytest
import yaml

from factorlib.errors import InputError
from factorlib.runner import words
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.plan import Listing, difference, plan
from factorlib.runner.project import LIBRARY, photo_sets
from factorlib.runner.survey import survey
from factorlib.runner.worker import Code, load_stage
from tests.faults.battered import make, real_project
from tests.faults.good import edited as edited_data
from tests.runner import toy
from tests.runner.toy import reasons, state, write

PIPELINE = read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices).for_data(lambda _: True)
STAGES = list(PIPELINE.stages)
LONG = pytest.mark.long


class Everything(dict):
    """A store that holds a result of every key, another for each."""

    def get(self, key, default=None):
        return f"output of {key}"


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """This project, to be edited."""
    return real_project(tmp_path_factory.mktemp("project"), "pipeline.yaml", "stages", "factorlib", "data", "recipes")


def planned(project, settings=(), dataset="synthetic"):
    """Every step, those of optional stages and of all recipes too, as planned were everything made."""
    seen = survey(project, dataset, STAGES, list(settings), recipes=["all"])
    return plan(seen.spec, seen.records, Listing(Everything(), {}))


def keys(project, settings=(), dataset="synthetic"):
    return {str(p.step): p.key for p in planned(project, settings, dataset)}


@cache
def usual(project, dataset="synthetic"):
    return keys(project, dataset=dataset)


def other_keys(project, settings=(), dataset="synthetic"):
    """The steps whose keys are not the usual ones."""
    before, now = usual(project, dataset), keys(project, settings, dataset)
    assert now.keys() == before.keys()
    return {step for step in now if now[step] != before[step]}


@contextlib.contextmanager
def edited(project, contents: dict[str, bytes | str]):
    """Within, files of the project hold something else."""
    before = {name: (project.root / name).read_bytes() for name in contents}
    usual(project), usual(project, "eames")
    try:
        for name, content in contents.items():
            (project.root / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        yield
    finally:
        for name, content in before.items():
            (project.root / name).write_bytes(content)


def below(project, steps, dataset="synthetic"):
    """Those steps, and all that take their results, however far: read from pipeline.yaml, step by step."""
    found = set(steps)
    for name in PIPELINE.order():
        of = (step for step in usual(project, dataset) if step.partition("/")[0] == name)
        found |= {step for step in of if any(_takes(step, above) for above in found)}
    return found


def _takes(step, above):
    (stage, _, photo), (above_stage, _, above_photo) = step.partition("/"), above.partition("/")
    alone = PIPELINE.stages[stage].over == "photo" and PIPELINE.stages[above_stage].over == "photo"
    return above_stage in PIPELINE.stages[stage].inputs and (photo == above_photo or not alone)


def steps_of(project, stages):
    return {step for step in usual(project) if step.partition("/")[0] in stages}


# ── code, files of packages, files of data sets ──────────────────────────────────────────────────────────────────────


@cache
def imports():
    return grimp.build_graph("factorlib", "stages", include_external_packages=True, cache_dir=None)


@cache
def reached_by(stage):
    """The modules that a stage imports, however far, and the packages above each, which Python runs first."""
    found, stack = set(), [f"stages.{stage}"]
    while stack:
        name = stack.pop()
        for part in (".".join(name.split(".")[: k + 1]) for k in range(name.count(".") + 1)):
            if part not in found and part in imports().modules:
                found.add(part)
                stack += imports().find_modules_directly_imported_by(part)
    return found


def users(project, module):
    """The steps that run a module, and those below."""
    return below(project, steps_of(project, {stage for stage in STAGES if module in reached_by(stage)}))


@cache
def modules():
    """{name: file within the project} of the modules that any stage runs."""
    paths = {name: Path(*name.split(".")) for name in sorted(set().union(*map(reached_by, STAGES)))}
    files = {name: (path.with_suffix(".py"), path / "__init__.py") for name, path in paths.items()}
    return {name: str(file) for name, both in files.items() for file in both if (LIBRARY / file).is_file()}


def text_of(module):
    return (LIBRARY / modules()[module]).read_text(encoding="utf-8")


def whole_modules(project, chance):
    for module in chance.sample(sorted(modules()), len(modules())):
        yield {modules()[module]: text_of(module) + "\nNEW = 1\n"}, "synthetic", users(project, module)


def remarks(project, chance):
    """Comments, docstrings and layout: texts that say the same to Python and YAML, of twenty modules at once."""
    for name in ("data/synthetic/dataset.yaml", "data/synthetic/truth/truth.yaml"):
        spec = yaml.safe_load((project.root / name).read_text())
        text = "# a remark\n" + yaml.safe_dump(spec, default_flow_style=True, sort_keys=False)
        yield {name: text}, "synthetic", set()
    mixed = chance.sample(sorted(modules()), len(modules()))
    for some in (mixed[k : k + 20] for k in range(0, len(mixed), 20)):
        anew, more = {}, {}
        for module in some:
            tree = ast.parse(text_of(module))
            for node in ast.walk(tree):
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
                    node.body[0].value.value = "Other words."
            anew[modules()[module]] = ast.unparse(tree)
            more[modules()[module]] = f"# a remark\n\n{text_of(module)}\n# another\n"
        yield from ((contents, "synthetic", set()) for contents in (anew, more))


def files_of_packages(project, chance):
    """Weights, templates, kernels: whatever lies in the folder of a module that is run."""
    root = project.root
    files = [path for path in sorted((root / "factorlib").rglob("*")) if path.is_file() and path.suffix != ".py"]
    for path in chance.sample(files, len(files)):
        package = ".".join(next(f for f in path.parents if (f / "__init__.py").exists()).relative_to(root).parts)
        in_it = lambda stage, package=package: package in {m.rpartition(".")[0] for m in reached_by(stage)}  # noqa: E731
        stages = {stage for stage in STAGES if package in reached_by(stage) or in_it(stage)}
        yield (
            {str(path.relative_to(root)): path.read_bytes() + b"\n"},
            "synthetic",
            below(project, steps_of(project, stages)),
        )


def files_of_data_sets(project, chance):
    folders = {dataset: LIBRARY / "data" / dataset for dataset in ("synthetic", "eames")}
    files = [
        (dataset, p)
        for dataset, f in folders.items()
        for p in sorted(f.rglob("*"))
        if p.is_file() and p.suffix != ".yaml"
    ]
    for dataset, path in chance.sample(files, len(files)):
        direct = readers(project, dataset, str(path.relative_to(folders[dataset])))
        yield {str(path.relative_to(LIBRARY)): path.read_bytes() + b"\n"}, dataset, below(project, direct, dataset)


def readers(project, dataset, file):
    """The steps that are handed a file of a data set, by what dataset.yaml says of it."""
    folder, found = LIBRARY / "data" / dataset, set()
    spec = yaml.safe_load((folder / "dataset.yaml").read_text())
    for photo in spec["photos"]:
        masks = photo["masks"] if isinstance(photo["masks"], dict) else {"": photo["masks"]}
        own = {obj.get("mask") for obj in photo["objects"]}
        meshes = {Path(spec["meshes"][obj["mesh"]]["file"]) for obj in photo["objects"]}
        rows = [
            (mesh, row) for mesh in meshes if mesh.suffix == ".obj" for row in (folder / mesh).read_text().splitlines()
        ]
        near = {str(mesh.parent / row.split()[1]) for mesh, row in rows if row.startswith("mtllib ")}
        if file in {photo["image"], *masks.values(), *own}:
            found |= takers(project, "dataset.photo", photo["name"], dataset)
        if file in {*map(str, meshes), *near, *own}:
            found |= takers(project, "dataset.objects", photo["name"], dataset)
    truth = yaml.safe_load((folder / spec["truth"]).read_text()) if spec.get("truth") else {}
    maps = {*truth.get("illumination", {}).values(), *truth.get("normals", {}).values()}
    return found | (takers(project, "dataset.truth", None, dataset) if file in maps else set())


def takers(project, slice_, photo, dataset):
    steps = (step.partition("/") for step in usual(project, dataset))
    taking = ((stage, mid, of) for stage, mid, of in steps if slice_ in PIPELINE.stages[stage].inputs)
    return {stage + mid + of for stage, mid, of in taking if PIPELINE.stages[stage].over != "photo" or of == photo}


CHANGES = {  # kind -> who makes them, at random, and how many a short and a long test take
    "a module": (whole_modules, 6, None),
    "comments, docstrings and layout": (remarks, 4, None),
    "a file of a package": (files_of_packages, 3, None),
    "a file of a data set": (files_of_data_sets, 6, None),
}


@pytest.mark.parametrize("most", [1, pytest.param(2, marks=LONG)], ids=["few", "all"])
@pytest.mark.parametrize("kind", CHANGES)
def test_a_change_reruns_who_is_reached_by_it_and_what_is_below_and_nothing_else(real, kind, most):
    for contents, dataset, reached in islice(CHANGES[kind][0](real, random.Random(17)), CHANGES[kind][most]):
        with edited(real, contents):
            assert other_keys(real, dataset=dataset) == reached, list(contents)[:3]


def test_an_edit_that_keeps_size_and_time_is_noticed(real):
    """Of a file of the data set, of a module and of a file of a package; all are old enough to be remembered."""
    for name, old, new in (
        ("data/synthetic/masks/study.png", b"IEND", b"IENE"),
        ("factorlib/urm/merge.py", b"return ", b"return-"),
        ("factorlib/reflection/kernel.c", b"int ", b"long"),
    ):
        path, before = real.root / name, (real.root / name).read_bytes()
        os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns - 10**10))
        known, stat = keys(real), path.stat()
        with edited(real, {name: before.replace(old, new, 1)}):
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            assert (path.stat().st_size, path.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
            assert keys(real) != known, name
    assert other_keys(real) == set()


@cache
def packages():
    """Distributions that any stage imports, and the names they are imported by."""
    distributions, found = packages_distributions(), {}
    for name in set().union(*map(reached_by, STAGES)) - modules().keys():
        for distribution in distributions.get(name, []):
            found.setdefault(distribution, set()).add(name)
    return found


@pytest.mark.parametrize("share", [6, pytest.param(1, marks=LONG)])
def test_another_version_of_a_package_reruns_who_imports_it(real, monkeypatch, share):
    usual(real, "synthetic")
    version, by, known = importlib.metadata.version, packages_distributions(), real.build / "store/cache/packages.json"
    monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: by)
    for distribution in sorted(packages())[::share]:
        newer = lambda name, it=distribution: f"{version(name)}.1" if name == it else version(name)  # noqa: E731
        monkeypatch.setattr(importlib.metadata, "version", newer)
        known.unlink(missing_ok=True)
        stages = {stage for stage in STAGES if packages()[distribution] & reached_by(stage)}
        assert stages and other_keys(real) == below(real, steps_of(real, stages)), distribution
    known.unlink(missing_ok=True)


def test_no_module_is_named_only_at_run_time():
    """`import_module(name)` hides a module from the keys of the steps that run it; the runner alone loads stages so.

    The package's own `__init__` hides `load_result` from every stage on purpose: no stage calls it.
    """
    loaders = {"import_module", "__import__", "run_path", "run_module", "spec_from_file_location"}
    files = {*(LIBRARY / "factorlib").rglob("*.py"), *(LIBRARY / "stages").rglob("*.py")}
    for path in files - {LIBRARY / "factorlib" / "__init__.py", *(LIBRARY / "factorlib" / "runner").rglob("*.py")}:
        nodes = ast.walk(ast.parse(path.read_text()))
        assert not {getattr(node, "id", getattr(node, "attr", "")) for node in nodes} & loaders, path
    assert not [p for p in (LIBRARY / "stages").glob("*.py") if "load_result" in p.read_text()]


# ── parameters ───────────────────────────────────────────────────────────────────────────────────────────────────────


def params_of(stage):
    return load_stage(Code(LIBRARY, "stages", stage, {}, LIBRARY / "pipeline.yaml")).Params


def leaves(values, above=""):
    for name, value in values.items():
        yield from leaves(value, f"{above}{name}.") if isinstance(value, dict) else [(above + name, value)]


def another(value):
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}_"
    if isinstance(value, list | tuple):
        return [another(value[0]), *value[1:]]
    return value + 1 if isinstance(value, int) else value * 1.5 + 0.001


def words_of(stage, values):
    return [f"{stage}.{name}={json.dumps(value, separators=(',', ':'))}" for name, value in values.items()]


def record_of(project, stage, settings=()):
    return next(p.record for p in planned(project, settings) if p.step.stage == stage)


WITH = [stage for stage in STAGES if [*leaves(msgspec.to_builtins(params_of(stage)()))]]


@pytest.mark.parametrize("stage", [
    pytest.param(stage, marks=() if stage in ("urm", "solve") else LONG) for stage in WITH
])  # fmt: skip
def test_each_parameter_reruns_its_stage_and_what_is_below(real, stage):
    values, before = dict(leaves(msgspec.to_builtins(params_of(stage)()))), record_of(real, stage)
    others = {name: another(value) for name, value in values.items()}
    lines = "\n".join(difference(before, record_of(real, stage, words_of(stage, others))))
    unnamed = [name for name in values if f"parameter {name}: " not in lines]  # the others each stand in the key
    for some in (others, *({name: others[name]} for name in unnamed)):
        assert other_keys(real, words_of(stage, some)) == below(real, steps_of(real, {stage})), some


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
    with pytest.raises(InputError, match=r"(?s)letters\.py.*ENVIRONMENT"):
        state(fresh)


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
    ("materials", ["red", "white", "wood"], "dataset.yaml: materials: 'wood' came"),
    ("materials", ["white", "red"], 'dataset.yaml: materials: ["red", "white"] -> ["white", "red"]'),
]  # fmt: skip


def test_the_field_and_the_parameter_that_changed_are_named_with_old_and_new(real, project, tmp_path):
    """As `make why` would print, if all had been made, then dataset.yaml changed."""
    for name in ("kitchen.jpg", "hall.jpg", "mask.png", "own.png", "chair.obj", "vase.ply"):
        write(tmp_path / "set" / name, "")

    def planned_with(spec=SET, settings=(), made=()):
        write(tmp_path / "set" / "dataset.yaml", yaml.safe_dump(spec))
        seen = survey(real, str(tmp_path / "set"), None, list(settings))
        listing = Listing({p.key: p.output for p in made}, {str(p.step): p.record for p in made})
        return plan(seen.spec, seen.records, listing if made else Listing(Everything(), {}))

    def why(made, spec=SET, settings=()):
        return "\n".join(words.plan_lines(planned_with(spec, settings, made), True))

    made, lobes = planned_with(), ["solve.lobes=48"]
    for place, value, line in FIELDS:
        text = why(made, edited_data(SET, *(int(w) if w.isdigit() else w for w in place.split(".")), value=value))
        assert line in text and "changed" not in text.replace("file ", "")
    linear = edited_data(SET, "photos", value=[photo | {"encoding": "linear"} for photo in SET["photos"]])
    assert why(made, linear).count("encoding") == 1, "what changed in every photo is said once"
    assert "parameter lobes: default -> 48" in why(made, settings=lobes)
    assert "parameter lobes: 48 -> default" in why(planned_with(settings=lobes))
    write(project.root / "stages" / "table.py", toy.TABLE.replace("scale: int = 2", "scale: int = 3"))
    assert reasons(project, "table") == ["source of stages.table: changed"]
