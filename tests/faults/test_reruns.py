"""Which steps get new keys by a single change: exactly those that the change can reach, and those below them.

Of a copy of this project, at the level of plans: files are edited, nothing is run.  Who can be reached by a change of
code another library says (grimp, of import-linter), who by a file of a data set, dataset.yaml.  `make test` takes a sample
that is the same each time, `make test-long` every module, file and package, and many lines.
"""

from __future__ import annotations

import ast
import contextlib
import importlib.metadata
import io
import json
import keyword
import os
import random
import shutil
import tokenize
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import grimp
import msgspec
import pytest
import yaml

from factorlib.errors import InputError
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.plan import Listing, difference, plan
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.runner.survey import survey
from factorlib.runner.worker import Code, load_stage
from tests.faults.test_many_photos import Everything
from tests.faults.tries import note

PIPELINE = read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices)
STAGES = list(PIPELINE.stages)
LINES, MANY_LINES, MODULES = 20, 600, 8  # of the samples


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """This project, to be edited."""
    root = tmp_path_factory.mktemp("project")
    for name in ("stages", "factorlib", "data", "recipes"):
        shutil.copytree(LIBRARY / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(LIBRARY / "pipeline.yaml", root)
    return Project(root, photo_sets())


def planned(project, settings=(), dataset="synthetic"):
    """Every step, those of optional stages and of all recipes too, as planned were everything made."""
    seen = survey(project, dataset, STAGES, list(settings), recipes=["all"])
    return plan(seen.spec, seen.records, Listing(Everything(), {}))


def keys(project, settings=(), dataset="synthetic"):
    return {str(p.step): p.key for p in planned(project, settings, dataset)}


@cache
def usual(project, dataset):
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
    usual(project, "synthetic"), usual(project, "eames")
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
        for step in usual(project, dataset):
            stage, _, photo = step.partition("/")
            if stage == name and any(_takes(stage, photo, above) for above in found):
                found.add(step)
    return found


def _takes(stage, photo, above):
    above_stage, _, above_photo = above.partition("/")
    alone = PIPELINE.stages[stage].over == "photo" and PIPELINE.stages[above_stage].over == "photo"
    return above_stage in PIPELINE.stages[stage].inputs and (photo == above_photo or not alone)


def steps_of(project, stages):
    return {step for step in usual(project, "synthetic") if step.partition("/")[0] in stages}


# ── code ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


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


def users(module):
    return {stage for stage in STAGES if module in reached_by(stage)}


@cache
def modules():
    """{name: file within the project} of the modules that any stage runs."""
    files = {}
    for name in sorted({name for stage in STAGES for name in reached_by(stage)}):
        path = Path(*name.split("."))
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if (LIBRARY / file).is_file():
                files[name] = str(file)
    return files


def text_of(module):
    return (LIBRARY / modules()[module]).read_text(encoding="utf-8")


OTHER = dict(
    zip(
        ["+", "-", "*", "/", "<", ">", "<=", ">=", "==", "!=", "|", "&", "+=", "-=", "True", "False", "and", "or"],
        ["-", "+", "/", "*", "<=", ">=", "<", ">", "!=", "==", "&", "|", "-=", "+=", "False", "True", "or", "and"],
    )
)


def mutations(text):
    """{line: texts in which one token of it is another}, but for docstrings; some are no Python."""
    bodies = [node.body for node in ast.walk(ast.parse(text)) if isinstance(getattr(node, "body", None), list)]
    texts = [
        item for body in bodies for item in body if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant)
    ]
    docstrings = {(item.lineno, item.col_offset) for item in texts}
    lines, by_line = text.splitlines(keepends=True), {}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        new = OTHER.get(token.string)
        if new is None and token.type in (tokenize.NAME, tokenize.NUMBER) and not keyword.iskeyword(token.string):
            new = token.string + ("7" if token.type == tokenize.NUMBER else "_")
        elif token.type == tokenize.STRING and token.start not in docstrings and not token.string.endswith('"""'):
            new = f"{token.string[:-1]}x{token.string[-1]}"
        if new is not None and token.start[0] == token.end[0]:
            line = lines[token.start[0] - 1]
            changed = line[: token.start[1]] + new + line[token.end[1] :]
            by_line.setdefault(token.start[0], []).append(
                "".join([*lines[: token.start[0] - 1], changed, *lines[token.start[0] :]])
            )
    return by_line


def imported(text):
    return [ast.dump(node) for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]


def check_line(project, module, texts):
    """Whether one of the texts imports the same: then what runs the module gets new keys, and what is below."""
    for text in texts:
        try:
            if imported(text) != imported(text_of(module)) or ast.dump(ast.parse(text)) == ast.dump(
                ast.parse(text_of(module))
            ):
                continue
            with edited(project, {modules()[module]: text}):
                assert other_keys(project) == below(project, steps_of(project, users(module))), module
            return True
        except (SyntaxError, InputError):
            continue
    return False


@pytest.mark.parametrize("lines", [LINES, pytest.param(MANY_LINES, marks=pytest.mark.long)])
def test_a_line_of_any_module_reruns_what_runs_it_and_what_is_below(project, lines):
    chance = random.Random(17)
    chosen = chance.sample(sorted(modules()), min(lines, len(modules())))
    every = [(module, texts) for module in chosen for texts in mutations(text_of(module)).values()]
    sample = chance.sample(every, lines)
    changed = sum(check_line(project, module, texts) for module, texts in sample)
    note("reruns", "a line of a module", changed)
    assert changed > 0.7 * len(sample), "the others import, or hold nothing that can be another"


@pytest.mark.parametrize("share", [MODULES, pytest.param(None, marks=pytest.mark.long)])
def test_a_change_of_a_module_changes_the_keys_of_what_runs_it_alone(project, share):
    """All modules of the project count that are imported, as grimp sees it."""
    chosen = sorted(modules()) if share is None else random.Random(3).sample(sorted(modules()), share)
    for module in chosen:
        with edited(project, {modules()[module]: text_of(module) + "\nNEW = 1\n"}):
            assert other_keys(project) == below(project, steps_of(project, users(module))), module
    note("reruns", "a module, all plans made anew", len(chosen))


def of_no_account(text):
    """By what was done: texts that say the same to Python."""
    lines, tree = text.splitlines(keepends=True), ast.parse(text)
    tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    alone = {t.start[0] for t in tokens if t.type == tokenize.COMMENT and not t.line[: t.start[1]].strip()}
    ends = {t.end[0] for t in tokens if t.type == tokenize.NEWLINE}
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and body and ast.get_docstring(node):
            body[0].value.value = "Other words."
    yield "comments", "".join(line for k, line in enumerate(lines, 1) if k not in alone) + "# a remark\n"
    yield "layout", "".join(line + ("\n" if k in ends else "") for k, line in enumerate(lines, 1))
    yield "docstrings, formatted anew", ast.unparse(tree)


@pytest.mark.parametrize("share", [8, pytest.param(1, marks=pytest.mark.long)])
def test_comments_docstrings_and_layout_change_no_key(project, share):
    """Of many modules at once: what changes no key together changes none alone."""
    changes = {}
    for module in list(modules())[::share]:
        for what, text in of_no_account(text_of(module)):
            changes.setdefault(what, {})[modules()[module]] = text
    for contents in changes.values():
        with edited(project, contents):
            assert other_keys(project) == set()
    note("reruns", "comments, docstrings and layout, modules", sum(map(len, changes.values())))


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


@pytest.mark.parametrize("stage", STAGES)
def test_each_parameter_of_a_stage_reruns_it_and_what_is_below_and_its_default_nothing(project, stage):
    values = defaults(stage)
    assert other_keys(project, words_of(stage, values)) == set(), "set to their defaults"
    others = {name: another(value) for name, value in values.items()}
    after = record_of(project, stage, words_of(stage, others))
    lines, reached = "\n".join(difference(record_of(project, stage), after)), below(project, steps_of(project, {stage}))
    alone = [
        name for name in values if f"parameter {name}: " not in lines
    ]  # the others each stand in the key by themselves
    for some in (others, *({name: others[name]} for name in alone)):
        assert not some or other_keys(project, words_of(stage, some)) == reached, some
    note("reruns", "a parameter", len(values))
    note("reruns", "a parameter set to its default", len(values))


def without_fields(text, class_, fields):
    """The source of a module whose class has lost some fields."""
    tree = ast.parse(text)
    node = next(node for node in tree.body if getattr(node, "name", None) == class_)
    node.body = [n for n in node.body if getattr(getattr(n, "target", None), "id", None) not in fields] + [ast.Pass()]
    return ast.unparse(tree)


@pytest.mark.parametrize("stage", [stage for stage in STAGES if defaults(stage)])
def test_parameters_that_are_removed_are_noticed_named_and_refused(project, stage):
    """Of each class in which fields of the parameters are written, all of them."""
    classes = {}
    for field in {name.partition(".")[0] for name in defaults(stage)}:
        owner = next(c for c in params_of(stage).__mro__ if field in getattr(c, "__annotations__", {}))
        classes.setdefault((owner.__module__, owner.__name__), []).append(field)
    before = record_of(project, stage)
    for (module, class_), fields in classes.items():
        with edited(project, {modules()[module]: without_fields(text_of(module), class_, fields)}):
            assert other_keys(project) == below(project, steps_of(project, users(module)))
            lines = difference(before, record_of(project, stage))
            assert all(any(line.startswith(f"default of parameter {field}:") for line in lines) for field in fields)
            with pytest.raises(InputError, match=f"has no parameter '{fields[0]}'"):
                keys(project, [f"{stage}.{fields[0]}=1"])
        note("reruns", "a parameter removed", len(fields))


def test_a_parameter_taken_out_of_pipeline_yaml_is_noticed(project):
    text = (project.root / "pipeline.yaml").read_text()
    more = text.replace("    cores: all\n", "    cores: all\n    params: {lobes: 48}\n", 1)
    with edited(project, {"pipeline.yaml": more}):
        assert other_keys(project) == below(project, steps_of(project, {"solve"}))
    assert other_keys(project) == set()


GIVEN = [(stage, param) for stage, found in PIPELINE.stages.items() for param in found.given]


@pytest.mark.parametrize("stage, param", GIVEN)
def test_a_folder_that_is_given_reruns_its_stage_and_what_is_below_by_content(project, tmp_path, stage, param):
    for folder in ("one", "same"):
        (tmp_path / folder).mkdir()
        for file in PIPELINE.stages[stage].given[param]:
            (tmp_path / folder / file).write_text("{}")
    given, same = ([f"{stage}.{param}={tmp_path / folder}"] for folder in ("one", "same"))
    assert other_keys(project, given) == below(project, steps_of(project, {stage})) and keys(project, given) == keys(
        project, same
    )
    note("reruns", "a folder that is given", 1)


# ── files, packages and the environment ──────────────────────────────────────────────────────────────────────────────


def readers(project, dataset, file):
    """The steps that are handed a file of a data set, by what dataset.yaml says of it."""
    folder, found = LIBRARY / "data" / dataset, set()
    spec = yaml.safe_load((folder / "dataset.yaml").read_text())
    for photo in spec["photos"]:
        masks = photo["masks"] if isinstance(photo["masks"], dict) else {"": photo["masks"]}
        own = {obj.get("mask") for obj in photo["objects"]}
        meshes = {spec["meshes"][obj["mesh"]]["file"] for obj in photo["objects"]}
        texts = {mesh: (folder / mesh).read_text().splitlines() for mesh in meshes if mesh.endswith(".obj")}
        near = {
            str(Path(mesh).parent / line.split()[1])
            for mesh in texts
            for line in texts[mesh]
            if line.startswith("mtllib ")
        }
        if file in {photo["image"], *masks.values(), *own}:
            found |= takers(project, "dataset.photo", photo["name"], dataset)
        if file in meshes | near | own:
            found |= takers(project, "dataset.objects", photo["name"], dataset)
    truth = yaml.safe_load((folder / spec["truth"]).read_text()) if spec.get("truth") else {}
    maps = {*truth.get("illumination", {}).values(), *truth.get("normals", {}).values()}
    return found | (takers(project, "dataset.truth", None, dataset) if file in maps else set())


def takers(project, slice_, photo, dataset):
    steps = (step.partition("/") for step in usual(project, dataset))
    taking = ((stage, mid, of) for stage, mid, of in steps if slice_ in PIPELINE.stages[stage].inputs)
    return {stage + mid + of for stage, mid, of in taking if PIPELINE.stages[stage].over != "photo" or of == photo}


@pytest.mark.parametrize("dataset", ["synthetic", "eames"])
def test_a_file_of_a_data_set_reruns_who_is_handed_it_and_what_is_below(project, dataset):
    folder = project.root / "data" / dataset
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".yaml")
    for path in files:
        with edited(project, {str(path.relative_to(project.root)): path.read_bytes() + b"\n"}):
            direct = readers(project, dataset, str(path.relative_to(folder)))
            assert other_keys(project, dataset=dataset) == below(project, direct, dataset), path
    note("reruns", "a file of a data set", len(files))


def test_remarks_and_layout_of_a_data_sets_yaml_change_no_key(project):
    for name in ("data/synthetic/dataset.yaml", "data/synthetic/truth/truth.yaml"):
        spec = yaml.safe_load((project.root / name).read_text())
        with edited(project, {name: "# a remark\n" + yaml.safe_dump(spec, default_flow_style=True, sort_keys=False)}):
            assert other_keys(project) == set()


def test_a_file_of_a_package_reruns_who_runs_that_package(project):
    """Weights, templates, kernels: whatever lies in the folder of a module that is run."""
    names = [str(p.relative_to(project.root)) for p in sorted((project.root / "factorlib").rglob("*")) if p.is_file()]
    data = [name for name in names if not name.endswith(".py")]
    counting = 0
    for name in data:
        folder = next(f for f in (project.root / name).parents if (f / "__init__.py").exists())
        package = ".".join(folder.relative_to(project.root).parts)
        stages = {
            s for s in STAGES if package in reached_by(s) or any(m.rpartition(".")[0] == package for m in reached_by(s))
        }
        with edited(project, {name: (project.root / name).read_bytes() + b"\n"}):
            assert other_keys(project) == below(project, steps_of(project, stages)), name
        counting += bool(stages)
    assert counting > 10 and "factorlib/reflection/kernel.c" in data
    note("reruns", "a file of a package", counting)


def test_an_edit_that_keeps_size_and_time_is_noticed(project):
    """Of a file of the data set, of a module and of a file of a package; all are old enough to be remembered."""
    for name, old, new in (("data/synthetic/masks/study.png", b"IEND", b"IENE"),
    ("factorlib/urm/merge.py", b"return ", b"return-"),
                           ("factorlib/reflection/kernel.c", b"int ", b"long")):  # fmt: skip
        path = project.root / name
        for _ in range(2):  # an edit, and back again
            os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns - 10**10))
            before, stat = keys(project), path.stat()
            path.write_bytes(path.read_bytes().replace(old, new, 1))
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            assert (path.stat().st_size, path.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
            assert keys(project) != before, name
            old, new = new, old
        note("reruns", "an edit that keeps size and time", 1)
    assert other_keys(project) == set()


@cache
def packages():
    """Distributions that any stage imports, and the names they are imported by."""
    distributions, found = packages_distributions(), {}
    for name in {name for stage in STAGES for name in reached_by(stage)} - modules().keys():
        for distribution in distributions.get(name, []):
            found.setdefault(distribution, set()).add(name)
    return found


@pytest.mark.parametrize("share", [5, pytest.param(1, marks=pytest.mark.long)])
def test_another_version_of_a_package_reruns_who_imports_it(project, monkeypatch, share):
    usual(project, "synthetic")
    version, by = importlib.metadata.version, packages_distributions()
    monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: by)
    for distribution in sorted(packages())[::share]:
        newer = lambda name, it=distribution: f"{version(name)}.1" if name == it else version(name)  # noqa: E731
        monkeypatch.setattr(importlib.metadata, "version", newer)
        (project.build / "store" / "cache" / "packages.json").unlink(missing_ok=True)
        stages = {stage for stage in STAGES if packages()[distribution] & reached_by(stage)}
        assert stages and other_keys(project) == below(project, steps_of(project, stages)), distribution
        note("reruns", "a package's version", 1)
    (project.build / "store" / "cache" / "packages.json").unlink(missing_ok=True)


def test_the_form_of_the_reflection_operator_is_in_the_keys_of_what_runs_it(project, monkeypatch):
    usual(project, "synthetic")
    stages = users("factorlib.reflection.fused")
    assert {"solve", "render", "refine", "train"} <= stages
    for name, value in (("FACTORLIB_FUSED", "0"), ("CC", "no-such-compiler")):
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            assert other_keys(project) == below(project, steps_of(project, stages))
