"""Which steps get new keys by any single change: exactly those that the change can reach, and those below them.

Of the real pipeline, at the level of plans: nothing is run.  Changes are generated, of every line of every module, every
parameter, every file of a data set, every file of a package, every package that is installed; who can be reached by a
change of code another library says (grimp, of import-linter), who by a file of a data set, dataset.yaml itself.
`make test` takes a sample that is the same each time, `make test-long` all of them.
"""

from __future__ import annotations

import ast
import json
import os
import random
import shutil
import time
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import grimp
import msgspec
import pytest
import yaml
from faults.changes import lines_of, of_each_line, of_no_account
from faults.tries import note

from factorlib.errors import InputError
from factorlib.runner import survey as survey_module
from factorlib.runner.closure import Packages, Source, Sources, Unknown, other_than, source_of
from factorlib.runner.filehash import FileHashes
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.plan import Listing, difference, plan
from factorlib.runner.project import LIBRARY, Project, Provider, photo_sets
from factorlib.runner.survey import survey
from factorlib.runner.worker import Code, load_stage

DATA = "synthetic"
LINES, MODULES = 60, 8  # of the sample
PIPELINE = read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices)


class Everything(dict):
    """A store that holds a result of every key, another for each."""

    def get(self, key, default=None):
        return f"output of {key}"


class Memory(FileHashes):
    """Hashes of files as they were first found, but for those that are edited.  edits: by file, its Source or its hash."""

    def __init__(self):
        super().__init__(None)
        self.edits, self.found = {}, {}

    def content(self, path):
        return self._of(path, lambda: super(Memory, self).content(path))

    def source(self, path, parse, type_):
        return self._of(path, parse)

    def _of(self, path, make):
        path = Path(os.path.abspath(path))
        if path in self.edits:
            return self.edits[path]
        if path not in self.found:
            self.found[path] = make()
        return self.found[path]

    def save(self):
        pass


MEMORY = Memory()
SETS = photo_sets()
PROJECT = Project(LIBRARY, Provider(SETS.slices, cache(SETS.read)))
CLOSURES = {}


class Remembered(Sources):
    """Closures as they were found, while no code is edited."""

    def closure(self, package, stage, pipeline_file):
        if self.hashes is not MEMORY or any(
            path.is_relative_to(LIBRARY / code) for path in MEMORY.edits for code in ("factorlib", "stages")
        ):
            return super().closure(package, stage, pipeline_file)
        if stage not in CLOSURES:
            CLOSURES[stage] = super().closure(package, stage, pipeline_file)
        return CLOSURES[stage]


@pytest.fixture(autouse=True)
def unchanged(monkeypatch):
    monkeypatch.setattr(survey_module, "FileHashes", lambda cache: MEMORY)
    monkeypatch.setattr(survey_module, "Sources", Remembered)
    MEMORY.edits.clear()
    yield
    MEMORY.edits.clear()


def planned(settings=(), dataset=DATA, project=PROJECT):
    """Every step, those of optional stages and of all recipes too, as planned were everything made."""
    seen = survey(project, dataset, list(PIPELINE.stages), list(settings), recipes=["all"])
    return plan(seen.spec, seen.records, Listing(Everything(), {}))


def keys(settings=(), dataset=DATA, project=PROJECT):
    return {str(p.step): p.key for p in planned(settings, dataset, project)}


@cache
def usual(dataset):
    return keys(dataset=dataset)


def other_keys(settings=(), dataset=DATA, project=PROJECT):
    """The steps whose keys are not the usual ones."""
    before, now = usual(dataset), keys(settings, dataset, project)
    assert now.keys() == before.keys()
    return {step for step in now if now[step] != before[step]}


def with_those_below(steps, dataset=DATA):
    """Those steps, and all that take their results, however far: read from pipeline.yaml, step by step."""
    found = set(steps)
    for name in PIPELINE.order():
        for step in usual(dataset):
            stage, _, of = step.partition("/")
            if stage == name and any(_takes(stage, of, above) for above in found):
                found.add(step)
    return found


def _takes(stage, of, above):
    above_stage, _, above_of = above.partition("/")
    alone = PIPELINE.stages[stage].over == "photo" and PIPELINE.stages[above_stage].over == "photo"
    return above_stage in PIPELINE.stages[stage].inputs and (of == above_of or not alone)


def steps_of(stages, dataset=DATA):
    return {step for step in usual(dataset) if step.partition("/")[0] in stages}


# ── who imports what, as import-linter's library sees it ─────────────────────────────────────────────────────────────


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


@cache
def all_modules():
    """The modules of the project that any stage runs, with their files."""
    sources = Sources([LIBRARY], MEMORY)
    names = sorted(
        {
            name
            for stage in PIPELINE.stages
            for name in reached_by(stage)
            if name.partition(".")[0] in ("factorlib", "stages")
        }
    )
    return {name: sources.find(name) for name in names}


def users(module):
    return {stage for stage in PIPELINE.stages if module in reached_by(stage)}


def edited(module, text) -> Source:
    file = all_modules()[module]
    return source_of(text, module, file.name == "__init__.py")


def test_the_modules_in_the_keys_are_those_that_are_imported():
    sources = Sources([LIBRARY], MEMORY)
    for stage in PIPELINE.stages:
        found = sources.closure("stages", stage, LIBRARY / "pipeline.yaml")
        assert set(found.modules) == {name for name in reached_by(stage) if name in all_modules()}


# ── lines of code ────────────────────────────────────────────────────────────────────────────────────────────────────


def check_line(module, number, texts):
    """Whether the line could be changed; the change is then seen by the steps that run the module, and by no other."""
    before = MEMORY.source(all_modules()[module], None, Source)
    for text in texts:
        try:
            now = edited(module, text)
        except (SyntaxError, InputError, RecursionError):
            continue
        if now.digest == before.digest:
            continue
        if (now.imports, now.environment, now.programs) != (before.imports, before.environment, before.programs):
            check_module(module, now)  # another closure
        elif now.names != before.names:
            check_defaults(module, now)
        return True
    return False


def check_module(module, now):
    """Another text of a module, from its first effect to its last."""
    MEMORY.edits[all_modules()[module]] = now
    try:
        assert other_keys() == with_those_below(steps_of(users(module))), module
    finally:
        MEMORY.edits.clear()


def check_defaults(module, now):
    """A change of names and defaults reaches no stage that does not run the module."""
    others = [stage for stage in PIPELINE.stages if stage not in users(module)]

    def of():
        """Return the parameters of the stages that do not run the module."""
        return [Sources([LIBRARY], MEMORY).stage_params("stages", stage, LIBRARY / "pipeline.yaml") for stage in others]

    before = of()
    MEMORY.edits[all_modules()[module]] = now
    try:
        assert of() == before, module
    finally:
        MEMORY.edits.clear()


def check_lines(chosen):
    """A line's change comes into a record as the digest of its module and nowhere else, unless it changes what is imported."""
    usual(DATA)
    changed = unchanged = 0
    for module, number, texts in chosen:
        if check_line(module, number, texts):
            changed += 1
        else:
            unchanged += 1
    note("reruns", "a line of a module", changed)
    assert changed > 10 * unchanged, "lines that hold nothing to change, such as `else:` and `)`"


def every_line():
    for module, file in all_modules().items():
        if file.is_file():
            for number, texts in of_each_line(file.read_text(encoding="utf-8")):
                yield module, number, texts


def test_a_line_of_any_module_reruns_what_runs_it_and_what_is_below():
    chosen = random.Random(17).sample(sorted(all_modules()), 30)
    lines = [found for found in every_line() if found[0] in chosen]
    check_lines(random.Random(17).sample(lines, LINES))


@pytest.mark.long
def test_every_line_of_every_module_reruns_what_runs_it_and_what_is_below():
    check_lines(every_line())


def one_line_of(module):
    """The module with its last line changed that can be and imports nothing."""
    text = all_modules()[module].read_text(encoding="utf-8")
    before = MEMORY.source(all_modules()[module], None, Source)
    for _, texts in reversed(list(of_each_line(text))):
        for new in texts:
            try:
                now = edited(module, new)
            except (SyntaxError, InputError):
                continue
            if now.digest != before.digest and now.imports == before.imports:
                return now
    return edited(module, text + "\nNEW = 1\n")  # a module without a line of code


def check_modules(modules):
    usual(DATA)
    for module in modules:
        check_module(module, one_line_of(module))
    note("reruns", "a module, all plans made anew", len(modules))


def files_of_modules():
    return [module for module, file in all_modules().items() if file.is_file()]


def test_a_change_of_a_module_changes_the_keys_of_what_runs_it_alone():
    check_modules(random.Random(3).sample(files_of_modules(), MODULES))


@pytest.mark.long
def test_a_change_of_every_module_changes_the_keys_of_what_runs_it_alone():
    check_modules(files_of_modules())


@pytest.mark.parametrize("share", [8, pytest.param(1, marks=pytest.mark.long)])
def test_comments_docstrings_and_layout_change_no_key(share):
    usual(DATA)
    tries = 0
    for module in files_of_modules()[::share]:
        text = all_modules()[module].read_text(encoding="utf-8")
        before = MEMORY.source(all_modules()[module], None, Source)
        for what, new in of_no_account(text).items():
            assert edited(module, new) == before, f"{module}: {what}"
            tries += (new != text) * len(lines_of(text))
    note("reruns", "comments, docstrings and layout, lines of modules", tries)


# ── parameters ───────────────────────────────────────────────────────────────────────────────────────────────────────


@cache
def params_of(stage):
    return load_stage(Code(LIBRARY, "stages", stage, {}, LIBRARY / "pipeline.yaml")).Params


def leaves(values, above=""):
    for name, value in values.items():
        yield from leaves(value, f"{above}{name}.") if isinstance(value, dict) else [(above + name, value)]


def defaults(stage):
    """The default of every parameter, as the struct itself has it."""
    return dict(leaves(msgspec.to_builtins(params_of(stage)())))


def word(value):
    return json.dumps(value, separators=(",", ":"))


def another(value):
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}_"
    if isinstance(value, list | tuple):
        return [another(value[0]), *value[1:]]
    return value + 1 if isinstance(value, int) else value * 1.5 + 0.001


ALL_PARAMETERS = [(stage, name) for stage in PIPELINE.stages for name in defaults(stage)]


@pytest.mark.parametrize("stage, name", ALL_PARAMETERS)
def test_a_parameter_reruns_its_stage_and_what_is_below_and_its_default_nothing(stage, name):
    default = defaults(stage)[name]
    assert other_keys([f"{stage}.{name}={word(default)}"]) == set(), "set to its default"
    assert other_keys([f"{stage}.{name}={word(another(default))}"]) == with_those_below(steps_of({stage}))
    note("reruns", "a parameter", 1)
    note("reruns", "a parameter set to its default", 1)


def test_all_parameters_at_their_defaults_are_none():
    words = [f"{stage}.{name}={word(defaults(stage)[name])}" for stage, name in ALL_PARAMETERS]
    assert other_keys(words) == set()


@pytest.mark.parametrize(
    "stage, param", [(stage, param) for stage, found in PIPELINE.stages.items() for param in found.given]
)
def test_a_folder_that_is_given_reruns_its_stage_and_what_is_below_by_content(tmp_path, stage, param):
    for folder in ("one", "same"):
        (tmp_path / folder).mkdir()
        for file in PIPELINE.stages[stage].given[param]:
            (tmp_path / folder / file).write_text("{}")
    given, same = (keys([f"{stage}.{param}={tmp_path / folder}"]) for folder in ("one", "same"))
    assert given == same and {step for step in given if given[step] != usual(DATA)[step]} == with_those_below(
        steps_of({stage})
    )
    note("reruns", "a folder that is given", 1)


def without_field(text, class_, field):
    """The source of a module whose class has lost a field, and the text that explains it."""
    tree = ast.parse(text)
    for node in tree.body:
        if getattr(node, "name", None) == class_:
            at = next(
                k for k, item in enumerate(node.body) if getattr(getattr(item, "target", None), "id", None) == field
            )
            del node.body[at]
    return ast.unparse(tree)


def owner(stage, field):
    """The module and the class in which a field of a stage's parameters is written."""
    cls = next(cls for cls in params_of(stage).__mro__ if field in getattr(cls, "__annotations__", {}))
    return cls.__module__, cls.__name__


@pytest.mark.parametrize("stage, field", sorted({(stage, name.partition(".")[0]) for stage, name in ALL_PARAMETERS}))
def test_a_parameter_that_is_removed_is_seen_named_and_refused(stage, field):
    before = next(p.record for p in planned() if p.step.stage == stage)
    module, class_ = owner(stage, field)
    text = without_field(all_modules()[module].read_text(encoding="utf-8"), class_, field)
    MEMORY.edits[all_modules()[module]] = edited(module, text)
    assert other_keys() == with_those_below(steps_of(users(module)))
    now = next(p.record for p in planned() if p.step.stage == stage)
    assert any(line.startswith(f"default of parameter {field}:") for line in difference(before, now))
    with pytest.raises(InputError, match=f"has no parameter '{field}'"):
        keys([f"{stage}.{field}=1"])
    note("reruns", "a parameter removed", 1)


def test_a_parameter_taken_out_of_pipeline_yaml_is_seen(tmp_path):
    project = copied(tmp_path)
    words = (project.root / "pipeline.yaml").read_text()
    (project.root / "pipeline.yaml").write_text(
        words.replace("    cores: all\n", "    cores: all\n    params: {lobes: 48}\n", 1)
    )
    assert other_keys(project=project) == with_those_below(steps_of({"solve"}))
    (project.root / "pipeline.yaml").write_text(words)
    assert other_keys(project=project) == set()


CONDITIONAL = (
    "import msgspec\nGAIN = 1\nif msgspec:\n    GAIN = 2\nclass Params(msgspec.Struct):\n    gain: int = GAIN\n"
)


def test_a_default_that_the_source_does_not_tell_for_certain_is_no_default(tmp_path):
    """A key that is too new costs time; one that is too old would give the result of another parameter."""
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "s.py").write_text(CONDITIONAL)
    defaults = Sources([tmp_path], FileHashes(None)).stage_params("m", "s", tmp_path / "pipeline.yaml")
    assert defaults == {"gain": "GAIN"} and isinstance(defaults["gain"], Unknown)
    assert other_than(defaults, {"gain": 1}) == {"gain": 1} and other_than(defaults, {"gain": "GAIN"}) != {}


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def copied(tmp_path, dataset=DATA):
    """This project with a data set and recipes of its own, to be edited."""
    for name in ("stages", "factorlib"):
        (tmp_path / name).symlink_to(LIBRARY / name)
    shutil.copy(LIBRARY / "pipeline.yaml", tmp_path)
    shutil.copytree(LIBRARY / "data" / dataset, tmp_path / "data" / dataset)
    shutil.copytree(LIBRARY / "recipes", tmp_path / "recipes")
    return Project(tmp_path, photo_sets())


def readers(dataset, file):
    """The steps that are handed a file of a data set, by what dataset.yaml says of it."""
    folder = LIBRARY / "data" / dataset
    spec = yaml.safe_load((folder / "dataset.yaml").read_text())
    found = set()
    for photo in spec["photos"]:
        masks = photo["masks"] if isinstance(photo["masks"], dict) else {"": photo["masks"]}
        own = {obj.get("mask") for obj in photo["objects"]}
        meshes = {spec["meshes"][obj["mesh"]]["file"] for obj in photo["objects"]}
        near = {
            str(Path(mesh).parent / line.split()[1])
            for mesh in meshes
            if mesh.endswith(".obj")
            for line in _lines(folder / mesh, "mtllib")
        }
        found |= (
            _takers("dataset.photo", photo["name"], dataset)
            if file in {photo["image"], *masks.values(), *own}
            else set()
        )
        found |= _takers("dataset.objects", photo["name"], dataset) if file in meshes | near | own else set()
    truth = yaml.safe_load((folder / spec["truth"]).read_text()) if spec.get("truth") else {}
    maps = {*truth.get("illumination", {}).values(), *truth.get("normals", {}).values()}
    return found | (_takers("dataset.truth", None, dataset) if file in maps else set())


def _lines(file, word):
    return [line for line in file.read_text().splitlines() if line.startswith(word + " ")]


def _takers(slice_, photo, dataset):
    return {step for step in usual(dataset) if slice_ in PIPELINE.stages[step.partition("/")[0]].inputs and
            (PIPELINE.stages[step.partition("/")[0]].over != "photo" or step.partition("/")[2] == photo)}  # fmt: skip


FILES = [
    (dataset, str(path.relative_to(LIBRARY / "data" / dataset)))
    for dataset in ("synthetic", "eames")
    for path in sorted((LIBRARY / "data" / dataset).rglob("*"))
    if path.is_file() and path.suffix != ".yaml"
]


@pytest.mark.parametrize("dataset, file", FILES)
def test_a_file_of_a_data_set_reruns_who_is_handed_it_and_what_is_below(dataset, file):
    usual(dataset)
    MEMORY.edits[LIBRARY / "data" / dataset / file] = "0" * 32
    direct = readers(dataset, file)
    assert other_keys(dataset=dataset) == with_those_below(direct, dataset)
    note("reruns", "a file of a data set", 1)


@cache
def data_files():
    sources = Sources([LIBRARY], MEMORY)
    closures = {stage: sources.closure("stages", stage, LIBRARY / "pipeline.yaml") for stage in PIPELINE.stages}
    return sorted({closure.files[f"data:{name}"] for closure in closures.values() for name in closure.data})


def in_package(file):
    """The package in whose folder, or below it, a file lies."""
    folder = next(folder for folder in file.parents if (folder / "__init__.py").exists())
    return ".".join(folder.relative_to(LIBRARY).parts)


@pytest.mark.parametrize("file", data_files(), ids=lambda file: str(file.relative_to(LIBRARY)))
def test_a_file_of_a_package_reruns_who_runs_that_package(file):
    MEMORY.edits[file] = "0" * 32
    package = in_package(file)
    stages = {
        stage
        for stage in PIPELINE.stages
        if package in reached_by(stage) or any(m.rpartition(".")[0] == package for m in reached_by(stage))
    }
    assert stages and other_keys() == with_those_below(steps_of(stages))
    note("reruns", "a file of a package", 1)


@pytest.mark.parametrize("name", ["dataset.yaml", "truth/truth.yaml"])
def test_remarks_and_layout_of_a_data_sets_yaml_change_no_key(tmp_path, name):
    project = copied(tmp_path)
    file = project.root / "data" / DATA / name
    file.write_text(
        "# a remark\n" + yaml.safe_dump(yaml.safe_load(file.read_text()), default_flow_style=True, sort_keys=False)
    )
    assert other_keys(project=project) == set()


def test_an_edit_that_keeps_size_and_time_is_seen(tmp_path, monkeypatch):
    """Of a file of the data set, of a module and of a file of a package, with what is remembered of them on disk."""
    monkeypatch.setattr(survey_module, "FileHashes", FileHashes)
    project = copied(tmp_path)
    for name in ("stages", "factorlib"):
        (project.root / name).unlink()
        shutil.copytree(LIBRARY / name, project.root / name, ignore=shutil.ignore_patterns("__pycache__"))
    time.sleep(2.1)  # younger files are not remembered
    before = keys(project=project)
    assert keys(project=project) == before
    table = json.loads((project.build / "store/cache/files.json").read_bytes())
    for name in (f"data/{DATA}/masks/study.png", "factorlib/urm/merge.py", "factorlib/reflection/kernel.c"):
        path = project.root / name
        assert any(str(path) in part for part in (table["contents"], table["sources"])), "it is remembered"
        stat, content = path.stat(), path.read_bytes()
        path.write_bytes(_one_other(content, name))
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert (path.stat().st_size, path.stat().st_mtime_ns) == (
            stat.st_size,
            stat.st_mtime_ns,
        ) and path.read_bytes() != content
        assert keys(project=project) != before, name
        path.write_bytes(content)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert keys(project=project) == before, name
        note("reruns", "an edit that keeps size and time", 1)


def _one_other(content, name):
    """One byte of a picture or a file of a package, one operator of a module."""
    if name.endswith(".py"):
        return content.replace(b"return ", b"return-", 1)
    if name.endswith(".c"):
        return content.replace(b"int ", b"long", 1)
    return content[:-20] + bytes([content[-20] ^ 1]) + content[-19:]


# ── packages ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@cache
def packages():
    """Distributions that any stage imports, and the names they are imported by."""
    names = {name for stage in PIPELINE.stages for name in reached_by(stage)} - all_modules().keys()
    by = packages_distributions()
    found = {}
    for name in names:
        for distribution in by.get(name, []):
            found.setdefault(distribution, set()).add(name)
    return found


@pytest.mark.parametrize("distribution", sorted(packages()))
def test_another_version_of_a_package_reruns_who_imports_it(monkeypatch, distribution):
    class Newer(Packages):
        def versions(self, imports):
            return {
                name: f"{version}.1" if name == distribution else version
                for name, version in super().versions(imports).items()
            }

    monkeypatch.setattr(survey_module, "Packages", Newer)
    stages = {stage for stage in PIPELINE.stages if packages()[distribution] & reached_by(stage)}
    assert stages and other_keys() == with_those_below(steps_of(stages))
    note("reruns", "a package's version", 1)
