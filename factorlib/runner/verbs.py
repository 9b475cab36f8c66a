"""Verbs of the command line.  Each shows or runs the same plan, and returns the exit code."""

from __future__ import annotations

import ast
import inspect
import os
import signal
import sys
import textwrap
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import inspect as types

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.dataset_state import Survey, survey
from factorlib.runner.plan import Planned, Step, difference, in_short
from factorlib.runner.project import RESERVED, Code, Pipeline, Project, check_name, read_pipeline
from factorlib.runner.results_folder import Home, claim, home_of, homes_of, label, made_homes
from factorlib.runner.store import Store, is_locked, sound_lines
from factorlib.runner.store import ship as put_into_package
from factorlib.wholefile import write_text

INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM  # exit codes, as shells count
VERDICT = "evaluate/verdict.txt"  # whose first line says whether the result is to be trusted
UNTRUSTED, NO_TRUST = 3, "do not trust"  # the exit code under STRICT=1, and how that line begins then
RESULTS = {  # what a user looks at first
    "report": "report/index.html",
    "materials": "export/materials.json",
    "environment maps": "export/illumination",
    "re-syntheses": "render/resynthesis",
}


class Wish(NamedTuple):
    """Request of the command line, as `survey` takes it.

    targets:  stages; None for all but those that run only when asked for
    settings: `stage.parameter=value`;  force: run the targets again, whatever the store holds
    recipes:  paths, names or `all`: stages over recipes make their pictures
    """

    dataset: str
    targets: list[str] | None = None
    settings: Sequence[str] = ()
    force: bool = False
    recipes: Sequence[str] = ()


def check_stage(project: Project, name: str, verbs: list[str]) -> None:
    """Raise InputError for a word of the command line that is neither a verb nor the name of a stage."""
    stages = _pipeline(project).stages
    if name not in stages:
        near = did_you_mean(name, [*stages, *verbs])
        cure = near if near.startswith("did") else "make help-all lists what there is"
        raise InputError(f"there is no verb or stage {name!r}", cure=cure)


def _pipeline(project: Project) -> Pipeline:
    return read_pipeline(project.pipeline_file, project.provider.slices)


def _say(seen: Survey, text: str) -> None:
    print(f"{seen.data.folder.name}: {text}")


def make(project: Project, wish: Wish, strict: bool = False) -> int:
    """Run the requested stages and those that they need, as far as they are not up to date.

    strict: return UNTRUSTED for a result not to be trusted
    """
    started, seen = time.perf_counter(), survey(project, *wish)
    planned = seen.planned()
    todo = [p.step for p in planned if p.status != "current"]
    if not todo:
        seen.show(planned)
        _say(seen, f"nothing to do, all {len(seen.records)} steps are current")
    elif faults := seen.faults(todo, new=True):
        return _refused(seen, faults)
    elif code := _run(seen, started):
        return code
    home, whole = seen.home.folder, wish.targets is None  # of the whole pipeline, name what a user looks at first
    judged = (home / VERDICT).read_text(encoding="utf-8") if whole and (home / VERDICT).exists() else ""
    for number, line in enumerate(judged.splitlines()):
        print(f"  verdict: {line}" if number == 0 else f"    {line}")
    for what, path in RESULTS.items() if whole else ():
        if (home / path).exists():
            print(f"  {what}: {project.shown(home / path)}" + ("/*.exr" if (home / path).is_dir() else ""))
    for name in seen.spec.targets or ():
        over_recipes = seen.spec.pipeline.stages[name].over == "recipe"
        if over_recipes or not whole:
            one = next(iter(seen.recipes)) if over_recipes and len(seen.recipes) == 1 else ""
            print(f"  {name}: {project.shown(home / name / one)}")
    return UNTRUSTED if strict and judged.startswith(NO_TRUST) else 0


def _run(seen: Survey, started: float) -> int:
    from factorlib.runner.display import Display
    from factorlib.runner.run import run

    display = Display()
    try:
        if wrong := seen.wrong_values(seen.planned()):
            return _refused(seen, wrong, "parameters")
        ran = run(seen, display)
    except (KeyboardInterrupt, SystemExit) as stop:
        display.say("stopped; what was finished is kept, the next run goes on from there")
        return INTERRUPTED if isinstance(stop, KeyboardInterrupt) else TERMINATED
    finally:
        display.close()
    if failed := list(ran.failed):
        _say(seen, f"{count(failed)} failed: {in_short(failed, NAMED, ', ')}")
        if ran.held_up:
            print(f"not run for that: {', '.join(dict.fromkeys(step.stage for step in ran.held_up))}")
        return 1
    current, seconds = len(seen.records) - len(ran.ran), time.perf_counter() - started
    _say(seen, f"{count(ran.ran)} run, {current} current, {seconds:.1f} s")
    return 0


def _refused(seen: Survey, faults: list[str], where: str = "files") -> int:
    """Print every fault at once, before anything has run."""
    for fault in faults:
        print(f"error: {fault}", file=sys.stderr)
    print(f"{seen.data.folder.name}: {count(faults, 'fault')} in its {where}; nothing was run", file=sys.stderr)
    return 1


def show_plan(project: Project, wish: Wish, every_reason: bool = False) -> int:
    """Print the steps that would run, with one reason or all; return 1 if a parameter has a wrong value."""
    seen = survey(project, *wish, look=True)
    planned = seen.planned()
    if faults := seen.wrong_values(planned):
        return _refused(seen, faults, "parameters")
    print("\n".join(plan_lines(planned, every_reason)))
    return 0


def show_status(project: Project, wish: Wish) -> int:
    """Print the progress of each stage, and its warnings."""
    seen, states, warnings = survey(project, *wish, look=True), {}, {}
    for p in seen.planned():
        running = p.key and p.status != "current" and is_locked(seen.store.locks / f"{p.key}.lock")
        states.setdefault(p.step.stage, []).append("running" if running else p.status)
        said = (event["text"] for event in _events(seen, p) if event["event"] == "warning")
        warnings |= dict.fromkeys(f"warning: {p.step}: {text}" for text in said)
    for stage, of in states.items():
        counts = (f"{of.count(s)} {s}" for s in ("current", "running", "to run", "maybe") if s in of)
        print(f"{stage:<10} {', '.join(counts)}")
    for warning in warnings:
        print(warning)
    return 0


def _events(seen: Survey, planned: Planned) -> list[dict]:
    """Read the log of a step's current result."""
    lines = sound_lines(seen.store.log(planned.key)) if planned.status == "current" else []
    return [{"text": "", **msgspec.json.decode(line)} for line in lines]


def show_graph(project: Project, mermaid: bool = False) -> int:
    """Print the stages in order of execution, each with its inputs; or a Mermaid diagram.

    In the diagram stages over photos or recipes have double frames.
    """
    pipeline = _pipeline(project)
    stages = {name: pipeline.stages[name] for name in pipeline.order()}
    if mermaid:
        nodes = [f"  {name}[[{name}]]" if stage.over else f"  {name}[{name}]" for name, stage in stages.items()]
        arrows = [f"  {above} --> {name}" for name, stage in stages.items() for above in stage.upstream]
        print("graph TD", *nodes, *arrows, sep="\n")
        return 0
    for name, stage in stages.items():
        over = f"per {stage.over}" if stage.over else "whole set"
        when = "   (only for sets that need it)" if stage.when else ""
        when = "   (only when asked for)" if stage.optional else when
        print(f"{name:<10} {over:<10} <- {', '.join(stage.inputs) or '(parameters only)'}{when}")
    return 0


def show_logs(project: Project, wish: Wish, photo: str | None) -> int:
    """Print time, memory, warnings and versions of current results; of one photo or recipe, or of all."""
    seen, logged = survey(project, *wish, look=True), []
    for p in seen.planned():
        if p.step.stage in (wish.targets or [p.step.stage]) and photo in (None, p.step.of):
            error = seen.home.errors / f"{label(p.step)}.txt"
            logged.append((p, _events(seen, p), project.shown(error) if error.is_file() else None))
    if not logged:
        cure = did_you_mean(str(photo), [*seen.data.photos, *seen.recipes])
        raise InputError(f"no step is of {photo!r}", key="PHOTO", cure=cure)
    print("\n".join(log_lines(logged)))
    return 0


def show_params(project: Project, stages: list[str] | None) -> int:
    """Print every parameter of the stages, or of all, with default, range and meaning."""
    from factorlib.runner.worker import load_stage

    for number, name in enumerate(stages or _pipeline(project).order()):
        check_stage(project, name, [])
        params = load_stage(Code(project.code_root, project.package, name, {}, project.pipeline_file)).Params
        lines = [""] * (number > 0)
        for param, may_be, default, text in parameters(params):
            lines.append(f"{name}.{param} = {default}    ({may_be})")
            lines += textwrap.wrap(text, 100, initial_indent="    ", subsequent_indent="    ")
        print("\n".join(lines if any(lines) else [*lines, f"{name} has no parameters"]))
    return 0


def validate(project: Project, dataset: str, settings: list[str], sheet: bool = False) -> int:
    """Check pipeline.yaml, the settings, dataset.yaml and every file that it names (only the headers of photos).

    sheet: also write build/<dataset>/sheet.png, each photo beside its labels and meshes, whatever is wrong
    """
    if sheet:
        _draw_sheet(project, project.dataset_folder(dataset))
    seen = survey(project, dataset, None, settings)
    if faults := seen.wrong_values(seen.planned()):
        return _refused(seen, faults, "parameters")
    if faults := seen.faults(seen.records):
        return _refused(seen, faults)
    counts = f"{len(seen.data.photos)} photos, {len(seen.records)} steps"
    _say(seen, f"pipeline.yaml, dataset.yaml and the files it names are good: {counts}")
    for caution in seen.data.cautions():
        print(f"  warning: {caution}")
    print(f"next: {project.command('all', dataset)}")
    return 0


def _draw_sheet(project: Project, folder: Path) -> None:
    """Draw each photo of a dataset beside its labels and meshes; the dataset may be unfinished."""
    from factorlib.runner.display import Display

    claim(project, home := home_of(project, folder), folder)
    path, step, started, display = home.folder / "sheet.png", Step("sheet"), time.monotonic(), Display()
    draw = import_module("factorlib.sheet").write_sheet  # science, by its name as stages are
    display.start(step)
    try:
        draw(folder, path, lambda done, all_: (display.progress(step, done, all_, ""), display.tick()))
        display.finish(step, time.monotonic() - started)
    finally:
        display.close()
    print(f"  contact sheet: {project.shown(path)}")


def begin(project: Project, dataset: str, photos: Path | None, masks: Path | None, meshes: Path | None) -> int:
    """Create a dataset from folders of files, and print what is left to do."""
    if photos is None:
        cure = "add PHOTOS=<folder>, and MASKS=… and MESHES=… where there are some"
        raise InputError("no folder of photos is named", key="PHOTOS", cure=cure)
    folder = Path(os.path.abspath(dataset)) if "/" in dataset else project.root / "data" / dataset
    check_name(folder.name, "a dataset", key="DATASET", reserved=RESERVED)
    missing = import_module("factorlib.newset").new_dataset(folder, photos, masks, meshes)
    where = "; what it lacks, or leaves to you:" if missing else ""
    print(f"{project.shown(folder)}/dataset.yaml is written{where}")
    for line in missing:
        print(f"  {line}")
    try:
        _draw_sheet(project, folder)
    except InputError as fault:
        print(f"  no contact sheet: {fault}")
    first = "" if masks else f"name your materials in it, then {project.command('label', dataset)}, then "
    print(f"next: {first}{project.command('validate', dataset)}")
    return 0


def label_masks(project: Project, dataset: str, port: int) -> int:
    """Serve the page on which masks are drawn, until Ctrl-C."""
    import_module("factorlib.labelling.server").serve(project.dataset_folder(dataset), port)
    return 0


def compare(project: Project, first: Path | None, second: Path | None) -> int:
    """Write a page that compares two results, folders such as build/eames."""
    if first is None or second is None:
        raise InputError("two results are to be named", key="compare", cure="make compare A=build/eames B=<another>")
    homes = [Home(path if path.is_dir() else project.build / path) for path in (first, second)]
    for home, named in zip(homes, (first, second), strict=True):
        if not home.keys_file.is_file():
            known = [home.folder.name for home in made_homes(project)]
            cure = did_you_mean(str(named), known) if known else "make all DATASET=<name> makes one"
            raise InputError("there is no result here", file=named, key="compare", cure=cure)
    (one, other), store, changes = (home.keys() for home in homes), Store(project.store), set()
    for step in one.keys() & other.keys():
        pair = store.entry(one[step]), store.entry(other[step])
        if None in pair:
            changes = None  # which is not known
            break
        records = [{k: v for k, v in entry.record.items() if not k.startswith("input:")} for entry in pair]
        changes |= {f"{step.partition('/')[0]}: {change}" for change in difference(*records)}
    folders, changes = [home.folder for home in homes], changes if changes is None else sorted(changes)
    page = import_module("factorlib.report.comparison").comparison(*folders, changes)
    path = project.build / "compare" / "-".join(home.folder.name for home in homes) / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, page)
    print(f"comparison: {project.shown(path)}")
    return 0


def pack(project: Project, dataset: str, out: Path | None, replace: bool) -> int:
    """Pack a dataset's results into one zip file, which needs neither this checkout nor the dataset."""
    from factorlib.pack import pack as pack_all

    if not (homes := homes_of(project, dataset, "pack")):
        return 1
    out = Path(f"{homes[0].folder.name}.zip") if out is None else out
    count = pack_all(homes[0].folder, out, replace)
    print(f"{homes[0].folder.name}: {count} files, {out.stat().st_size / 1e6:.1f} MB\n  {out}")
    return 0


def ship(project: Project, stage: str, dataset: str) -> int:
    """Copy the current result of a stage into the package, if pipeline.yaml says that it ships with the source."""
    known = {name: found.shipped for name, found in _pipeline(project).stages.items() if found.shipped}
    if stage not in known:
        raise InputError(f"no result of {stage!r} ships with the source", key="ship", cure=did_you_mean(stage, known))
    seen = survey(project, dataset, [stage], [])
    planned = next(p for p in seen.planned() if p.step.stage == stage)
    if planned.status != "current":
        raise InputError(f"{stage!r} has no current result", key="ship", cure=f"make {stage} DATASET={dataset} FORCE=1")
    folder = put_into_package(seen.store.trees / planned.output, planned.record, project.root, known[stage])
    print(f"{stage}: {project.shown(folder)}")
    return 0


# ── in words ─────────────────────────────────────────────────────────────────────────────────────────────────────────

SHOWN = 8  # reasons of one step that are written out
NAMED = 20  # steps that have failed


def plan_lines(planned: list[Planned], every_reason: bool = False) -> list[str]:
    """Format the plan, with one line for all steps of a stage that have the same reasons but for the photo's name.

    every_reason: below it, a line each
    """
    groups: dict[tuple, list[Step]] = {}
    for p in (p for p in planned if p.status != "current"):
        reasons = tuple(_of_any_photo(reason, p.step) for reason in p.reasons)
        groups.setdefault((p.step.stage, p.status, reasons), []).append(p.step)
    lines = []
    for (stage, status, reasons), steps in groups.items():
        names = [step.of for step in steps if step.of]
        items = ", ".join(names) if len(names) <= 3 else f"{len(names)} {'recipes' if steps[0].recipe else 'photos'}"
        in_line = "" if every_reason else in_short(reasons, SHOWN)
        lines.append(f"{stage:<10} {status:<7} {items:<24} {in_line}".rstrip())
        lines += [f"    {reason}" for reason in reasons] if every_reason else []
    current = sum(p.status == "current" for p in planned)
    return [*lines, f"{current} of {len(planned)} steps are current" if lines else f"all {current} steps are current"]


def _of_any_photo(reason: str, step: Step) -> str:
    """`masks/kitchen` is `masks` to the step of the kitchen, `photos.kitchen.image` is `photos.*.image`.

    >>> _of_any_photo("if masks/kitchen, train comes out different", Step("align", "kitchen"))
    'if masks, train comes out different'
    """
    if step.photo and reason.startswith(("if ", "result of ")):
        return reason.replace(f"/{step.photo}", "")
    if step.photo and reason.startswith("dataset.yaml:"):
        return reason.replace(f" photos.{step.photo}.", " photos.*.", 1)
    return reason


def count(items: list, one: str = "step") -> str:
    """Format a number of items with their unit.

    >>> count(["a"]), count(["a", "b"], "fault")
    ('1 step', '2 faults')
    """
    return f"{len(items)} {one}{'' if len(items) == 1 else 's'}"


def log_lines(logged: list[tuple[Planned, list[dict], str | None]]) -> list[str]:
    """Return cost and warnings of each step, and all package versions that the steps were made with.

    logged: steps with the events of their results' logs, and the file that says by which defect one failed
    """
    lines, made = [], {}
    for planned, events, failed in logged:
        lines.append(f"{planned.step!s:<26} {_cost(planned, events)}".rstrip())
        lines += [f"    warning: {event['text']}" for event in events if event["event"] == "warning"]
        lines += [f"    it failed by a defect of the program: {failed}"] if failed else []
        for name, version in _made_with(planned, events).items():
            made.setdefault(name, {})[version] = None
    text = ", ".join(f"{name} {' or '.join(made[name])}" for name in sorted(made, key=str.lower))
    indents = {"initial_indent": "    made with ", "subsequent_indent": "    "}
    return lines + textwrap.wrap(text, 110, **indents)


def _cost(planned: Planned, events: list[dict]) -> str:
    done = next((event for event in reversed(events) if event["event"] == "done"), None)
    if planned.status != "current":
        return f"{planned.status}: {in_short(planned.reasons, SHOWN)}"
    if done is None:
        return "its log is not there"
    cores = f"{done['threads']} thread{'s' * (done['threads'] > 1)} on {done['cores']} core{'s' * (done['cores'] > 1)}"
    cost = f"{done['seconds']:8.1f} s {done['cpu_seconds']:8.1f} s processor {done['memory_mb']:7.0f} MB peak"
    return f"{cost}   {cores}   {done['started'][:16].replace('T', ' ')} UTC"


def _made_with(planned: Planned, events: list[dict]) -> dict[str, str]:
    """Return the versions of Python and of the packages that enter keys, and the kind of machine.

    Nothing is returned where there is no current result.
    """
    if planned.status != "current":
        return {}
    machine = next((event["machine"] for event in reversed(events) if "machine" in event), {})
    made = {"Python": machine["python"], machine["system"]: machine["processor"]} if machine else {}
    return made | {n.removeprefix("package:"): v for n, v in planned.record.items() if n.startswith("package:")}


def parameters(params: type) -> list[tuple[str, str, str, str]]:
    """List the fields of a stage's `Params` in order: name, allowed values, default in YAML, meaning.

    The meaning is the string that follows a field.  One that is a struct stands for its own fields, with dotted names.
    """
    texts, table = {}, []
    for cls in reversed(params.__mro__):
        if issubclass(cls, msgspec.Struct) and cls is not msgspec.Struct:
            body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
            for field, text in zip(body, body[1:]):
                match field, text:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(said)):
                        texts[name] = " ".join(str(said).split())
    for field in types.type_info(params).fields:
        if isinstance(field.type, types.StructType):
            table += [(f"{field.name}.{name}", *rest) for name, *rest in parameters(field.type.cls)]
        else:
            made = field.default is msgspec.NODEFAULT and callable(field.default_factory)
            value = field.default_factory() if made else field.default
            text = "none" if value is msgspec.NODEFAULT else msgspec.json.encode(value).decode().replace(",", ", ")
            table.append((field.name, allowed(field.type), text, texts.get(field.name, "")))
    return table


def allowed(of: Any) -> str:
    """Format the allowed values of a type of `msgspec.inspect`.

    >>> allowed(types.type_info(int)), allowed(types.IntType(ge=1, le=1024)), allowed(types.FloatType(gt=0))
    ('whole number', '1 … 1,024', 'number > 0')
    """
    if isinstance(of, types.IntType | types.FloatType):
        if of.ge is not None and of.le is not None:
            return f"{of.ge:,} … {of.le:,}"
        bounds = ((">", of.gt), ("≥", of.ge), ("<", of.lt), ("≤", of.le))
        words = " and ".join(f"{sign} {bound:,}" for sign, bound in bounds if bound is not None)
        return f"{'whole number' if isinstance(of, types.IntType) else 'number'} {words}".strip()
    if isinstance(of, types.LiteralType):
        return ", ".join(str(value) for value in sorted(of.values, key=str))
    if isinstance(of, types.UnionType):
        return " or ".join(map(allowed, of.types))
    if items := getattr(of, "item_types", None):
        return f"{len(items)} of: {allowed(items[0])}"
    words = {types.BoolType: "true, false", types.StrType: "text", types.NoneType: "null"}
    return words.get(type(of), type(of).__name__)
