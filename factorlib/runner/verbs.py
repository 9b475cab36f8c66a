"""Verbs of the command line.  Each shows or runs the same plan, and returns the exit code."""

from __future__ import annotations

import ast
import inspect
import os
import signal
import sys
import textwrap
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect as types

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.dataset_state import DatasetState, Request, read_state
from factorlib.runner.plan import Planned, Step, difference, summarize
from factorlib.runner.project import RESERVED, Pipeline, Project, StageCode, check_name, read_pipeline
from factorlib.runner.results_folder import ResultsFolder, all_results, find_results, label, results_of
from factorlib.runner.store import Store, is_locked, read_events
from factorlib.runner.store import ship as copy_into_package
from factorlib.wholefile import write_text

# exit codes as in shells
INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
UNTRUSTED = 3  # exit code under STRICT=1
VERDICT = "evaluate/verdict.txt"
NO_TRUST = "do not trust"  # beginning of an adverse verdict
MAIN_RESULTS = {
    "report": "report/index.html",
    "materials": "export/materials.json",
    "environment maps": "export/illumination",
    "re-syntheses": "render/resynthesis",
}


def check_stage(project: Project, name: str, verbs: list[str]) -> None:
    """Raise InputError for a word of the command line that is neither a verb nor the name of a stage."""
    stages = _pipeline(project).stages
    if name not in stages:
        cure = did_you_mean(name, [*stages, *verbs])
        cure = cure if cure.startswith("did") else "make help-all lists all verbs and stages"
        raise InputError(f"there is no verb or stage {name!r}", cure=cure)


def _pipeline(project: Project) -> Pipeline:
    return read_pipeline(project.pipeline_file, project.provider.slices)


def make(project: Project, request: Request, strict: bool = False) -> int:
    """Run the requested stages and those that they need, as far as they are not current.

    strict: return UNTRUSTED if the verdict is adverse
    """
    started = time.perf_counter()
    state = read_state(project, request)
    planned = state.plan()
    pending = [p.step for p in planned if p.status != "current"]
    if not pending:
        state.publish(planned)
        print(f"{state.data.folder.name}: nothing to do, all {len(state.records)} steps are current")
    elif faults := state.faults(pending, new=True):
        return _refuse(state, faults)
    elif code := _run(state, started):
        return code
    verdict = _print_results(state, request.targets is None)
    return UNTRUSTED if strict and verdict.startswith(NO_TRUST) else 0


def _print_results(state: DatasetState, whole: bool) -> str:
    """Print the places of the results, after a run of the whole pipeline those that a user looks at first.

    Returns the verdict, empty without one.
    """
    folder = state.results.folder
    shown = state.project.shown
    verdict = (folder / VERDICT).read_text(encoding="utf-8") if whole and (folder / VERDICT).exists() else ""
    for number, line in enumerate(verdict.splitlines()):
        print(f"    {line}" if number else f"  verdict: {line}")
    for name, path in MAIN_RESULTS.items() if whole else ():
        if (folder / path).exists():
            print(f"  {name}: {shown(folder / path)}" + ("/*.exr" if (folder / path).is_dir() else ""))
    for name in state.spec.targets or ():
        over_recipes = state.spec.pipeline.stages[name].over == "recipe"
        if over_recipes or not whole:
            item = next(iter(state.recipes)) if over_recipes and len(state.recipes) == 1 else ""
            print(f"  {name}: {shown(folder / name / item)}")
    return verdict


def _run(state: DatasetState, started: float) -> int:
    from factorlib.runner.display import Display
    from factorlib.runner.run import run

    display = Display()
    try:
        if faults := state.wrong_values(state.plan()):
            return _refuse(state, faults, "parameters")
        result = run(state, display)
    except (KeyboardInterrupt, SystemExit) as stop:
        display.report("stopped; what was finished is kept, the next run goes on from there")
        return INTERRUPTED if isinstance(stop, KeyboardInterrupt) else TERMINATED
    finally:
        display.close()
    name = state.data.folder.name
    if failed := list(result.failed):
        print(f"{name}: {count(failed)} failed: {summarize(failed, MOST_FAILED, ', ')}")
        if result.held_up:
            print(f"not run because of that: {', '.join(dict.fromkeys(step.stage for step in result.held_up))}")
        return 1
    current = len(state.records) - len(result.completed)
    print(f"{name}: {count(result.completed)} run, {current} current, {time.perf_counter() - started:.1f} s")
    return 0


def _refuse(state: DatasetState, faults: list[str], place: str = "files") -> int:
    """Print every fault, before anything has run."""
    lines = [f"error: {fault}" for fault in faults]
    print(
        *lines,
        f"{state.data.folder.name}: {count(faults, 'fault')} in its {place}; nothing was run",
        sep="\n",
        file=sys.stderr,
    )
    return 1


def show_plan(project: Project, request: Request, every_reason: bool = False) -> int:
    """Print the steps that would run, with the first reasons or all; return 1 if a parameter has a wrong value."""
    state = read_state(project, request, look=True)
    planned = state.plan()
    if faults := state.wrong_values(planned):
        return _refuse(state, faults, "parameters")
    print("\n".join(plan_lines(planned, every_reason)))
    return 0


def show_status(project: Project, request: Request) -> int:
    """Print the progress of each stage, and the warnings of current results."""
    state = read_state(project, request, look=True)
    counts: dict[str, dict[str, int]] = {}
    warnings: dict[str, None] = {}
    for p in state.plan():
        running = p.key and p.status != "current" and is_locked(state.store.locks / f"{p.key}.lock")
        stage = counts.setdefault(p.step.stage, dict.fromkeys(("current", "running", "to run", "maybe"), 0))
        stage["running" if running else p.status] += 1
        texts = [event["text"] for event in _events(state, p) if event["event"] == "warning"]
        warnings |= dict.fromkeys(f"warning: {p.step}: {text}" for text in texts)
    for name, numbers in counts.items():
        print(f"{name:<10} {', '.join(f'{number} {status}' for status, number in numbers.items() if number)}")
    for warning in warnings:
        print(warning)
    return 0


def _events(state: DatasetState, planned: Planned) -> list[dict[str, Any]]:
    """Return the log of a step's current result."""
    events = read_events(state.store.log(planned.key)) if planned.status == "current" else []
    return [{"text": "", **event} for event in events]


def show_graph(project: Project, mermaid: bool = False) -> int:
    """Print the stages in order, each with its inputs; or a Mermaid diagram, with double frames for many steps."""
    pipeline = _pipeline(project)
    stages = {name: pipeline.stages[name] for name in pipeline.order()}
    if mermaid:
        nodes = [f"  {name}[[{name}]]" if stage.over else f"  {name}[{name}]" for name, stage in stages.items()]
        arrows = [f"  {above} --> {name}" for name, stage in stages.items() for above in stage.upstream]
        print("graph TD", *nodes, *arrows, sep="\n")
        return 0
    for name, stage in stages.items():
        over = f"per {stage.over}" if stage.over else "whole set"
        remark = "   (only for sets that need it)" if stage.when else ""
        remark = "   (only on request)" if stage.optional else remark
        print(f"{name:<10} {over:<10} <- {', '.join(stage.inputs) or '(parameters only)'}{remark}")
    return 0


def show_logs(project: Project, request: Request, item: str | None) -> int:
    """Print time, memory, warnings and versions of current results; of one photo or recipe, or of all."""
    state = read_state(project, request, look=True)
    logs = []
    for p in state.plan():
        if p.step.stage in (request.targets or [p.step.stage]) and item in (None, p.step.item):
            error = state.results.errors / f"{label(p.step)}.txt"
            logs.append((p, _events(state, p), project.shown(error) if error.is_file() else None))
    if not logs:
        cure = did_you_mean(str(item), [*state.data.photos, *state.recipes])
        raise InputError(f"no step is of the photo or recipe {item!r}", key="PHOTO", cure=cure)
    print("\n".join(log_lines(logs)))
    return 0


def show_params(project: Project, stages: list[str] | None) -> int:
    """Print every parameter of the stages, or of all, with default, range and meaning."""
    from factorlib.runner.worker import load_stage

    for number, name in enumerate(stages or _pipeline(project).order()):
        check_stage(project, name, [])
        params = load_stage(StageCode(project.code_root, project.package, name, {}, project.pipeline_file)).Params
        lines = []
        for param, values, default, text in parameters(params):
            lines.append(f"{name}.{param} = {default}    ({values})")
            lines += textwrap.wrap(text, 100, initial_indent="    ", subsequent_indent="    ")
        print(*[""] * (number > 0), *(lines or [f"{name} has no parameters"]), sep="\n")
    return 0


def validate(project: Project, dataset: str, settings: list[str], sheet: bool = False) -> int:
    """Check pipeline.yaml, the settings, dataset.yaml and every file that it names (photos by their headers).

    sheet: first write build/<dataset>/sheet.png, each photo beside its labels and meshes
    """
    if sheet:
        _draw_sheet(project, project.dataset_folder(dataset))
    state = read_state(project, Request(dataset, settings=settings))
    if faults := state.wrong_values(state.plan()):
        return _refuse(state, faults, "parameters")
    if faults := state.faults(state.records):
        return _refuse(state, faults)
    counts = f"{len(state.data.photos)} photos, {len(state.records)} steps"
    print(f"{state.data.folder.name}: pipeline.yaml, dataset.yaml and the files it names are good: {counts}")
    for caution in state.data.cautions():
        print(f"  warning: {caution}")
    print(f"next: {project.command('all', dataset)}")
    return 0


def _draw_sheet(project: Project, folder: Path) -> None:
    """Draw each photo of a dataset beside its labels and meshes; the dataset may be unfinished."""
    from factorlib.runner.display import Display

    results = results_of(project, folder)
    results.set_owner(project, folder)
    path = results.folder / "sheet.png"
    step = Step("sheet")
    started = time.monotonic()
    display = Display()

    def progress(done: int, total: int) -> None:
        display.progress(step, done, total, "")
        display.tick()

    display.start(step)
    try:
        import_module("factorlib.sheet").write_sheet(folder, path, progress)  # by name: it is science
        display.finish(step, time.monotonic() - started)
    finally:
        display.close()
    print(f"  contact sheet: {project.shown(path)}")


def begin(project: Project, dataset: str, photos: Path | None, masks: Path | None, meshes: Path | None) -> int:
    """Create a dataset from folders of files, and print what is left to do."""
    if photos is None:
        cure = "add PHOTOS=<folder>, and MASKS=<folder> and MESHES=<folder> if you have these"
        raise InputError("no folder of photos is named", key="PHOTOS", cure=cure)
    folder = Path(os.path.abspath(dataset)) if "/" in dataset else project.root / "data" / dataset
    check_name(folder.name, "a dataset", key="DATASET", reserved=RESERVED)
    missing = import_module("factorlib.newset").new_dataset(folder, photos, masks, meshes)
    print(f"{project.shown(folder)}/dataset.yaml is written{'; still missing, or yours to decide:' if missing else ''}")
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
    """Serve the page for drawing masks, until Ctrl-C."""
    import_module("factorlib.labelling.server").serve(project.dataset_folder(dataset), port)
    return 0


def compare(project: Project, first: Path | None, second: Path | None) -> int:
    """Write a page that compares two results, folders such as build/eames."""
    if first is None or second is None:
        cure = "make compare A=build/eames B=<another folder of results>"
        raise InputError("two results must be named", key="compare", cure=cure)
    pair = [ResultsFolder(path if path.is_dir() else project.build / path) for path in (first, second)]
    for results, name in zip(pair, (first, second), strict=True):
        if not results.keys_file.is_file():
            known = [other.folder.name for other in all_results(project)]
            cure = did_you_mean(str(name), known) if known else "make all DATASET=<name> makes one"
            raise InputError("is no folder of results", file=name, key="compare", cure=cure)
    page = import_module("factorlib.report.comparison").comparison(
        *(results.folder for results in pair), _changes(Store(project.store), *(results.keys() for results in pair))
    )
    path = project.build / "compare" / "-".join(results.folder.name for results in pair) / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, page)
    print(f"comparison: {project.shown(path)}")
    return 0


def _changes(store: Store, first: dict[str, str], second: dict[str, str]) -> list[str] | None:
    """List the differences of two results ({step: key}) in sources, parameters and data; None if one is unknown."""
    changes = set()
    for step in first.keys() & second.keys():
        entries = store.entry(first[step]), store.entry(second[step])
        if entries[0] is None or entries[1] is None:
            return None
        lines = difference(entries[0].record, entries[1].record)
        changes |= {f"{step.partition('/')[0]}: {line}" for line in lines if not line.startswith("result of ")}
    return sorted(changes)


def pack(project: Project, dataset: str, out: Path | None, replace: bool) -> int:
    """Pack a dataset's results into one zip file, which needs neither this checkout nor the dataset."""
    from factorlib.pack import pack as write_zip

    if not (folders := find_results(project, dataset, "pack")):
        return 1
    folder = folders[0].folder
    out = out or Path(f"{folder.name}.zip")
    files = write_zip(folder, out, replace)
    print(f"{folder.name}: {files} files, {out.stat().st_size / 1e6:.1f} MB\n  {out}")
    return 0


def ship(project: Project, stage: str, dataset: str) -> int:
    """Copy the current result of a stage into the package, if pipeline.yaml declares that it ships with the source."""
    known = {name: found.shipped for name, found in _pipeline(project).stages.items() if found.shipped}
    if stage not in known:
        raise InputError(f"no result of {stage!r} ships with the source", key="ship", cure=did_you_mean(stage, known))
    state = read_state(project, Request(dataset, [stage]))
    planned = state.plan()[-1]
    if (entry := state.store.entry(planned.key)) is None or planned.status != "current":
        raise InputError(f"{stage!r} has no current result", key="ship", cure=f"make {stage} DATASET={dataset} FORCE=1")
    folder = project.root / known[stage].folder
    copy_into_package(state.store, entry, folder, known[stage].made_by)
    print(f"{stage}: {project.shown(folder)}")
    return 0


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

MOST_REASONS = 8  # reasons of one step on a line
MOST_FAILED = 20  # names of failed steps


def plan_lines(planned: list[Planned], every_reason: bool = False) -> list[str]:
    """Format a plan, with one line for all steps of a stage that have the same reasons but for the photo's name.

    every_reason: add a line for each reason
    """
    groups: dict[tuple, list[str]] = {}
    for p in (p for p in planned if p.status != "current"):
        kind = "recipes" if p.step.recipe else "photos"
        reasons = tuple(_for_any_photo(reason, p.step) for reason in p.reasons)
        groups.setdefault((p.step.stage, p.status, reasons, kind), []).append(p.step.item)
    lines = []
    for (stage, status, reasons, kind), names in groups.items():
        items = ", ".join(names) if len(names) <= 3 else f"{len(names)} {kind}"
        in_line = "" if every_reason else summarize(reasons, MOST_REASONS)
        lines.append(f"{stage:<10} {status:<7} {items:<24} {in_line}".rstrip())
        lines += [f"    {reason}" for reason in reasons] if every_reason else []
    current = sum(p.status == "current" for p in planned)
    return [*lines, f"{current} of {len(planned)} steps are current" if lines else f"all {current} steps are current"]


def _for_any_photo(reason: str, step: Step) -> str:
    """Remove the name of the step's photo from a reason.

    >>> _for_any_photo("if masks/kitchen, train comes out different", Step("align", "kitchen"))
    'if masks, train comes out different'
    """
    if step.photo and reason.startswith(("if ", "result of ")):
        return reason.replace(f"/{step.photo}", "")
    if step.photo and reason.startswith("dataset.yaml:"):
        return reason.replace(f" photos.{step.photo}.", " photos.*.", 1)
    return reason


def count(items: list, unit: str = "step") -> str:
    """Format a number of items with their unit.

    >>> count(["a"]), count(["a", "b"], "fault")
    ('1 step', '2 faults')
    """
    return f"{len(items)} {unit}{'' if len(items) == 1 else 's'}"


def log_lines(logs: list[tuple[Planned, list[dict], str | None]]) -> list[str]:
    """Format cost and warnings of each step, and all package versions that the steps were made with.

    logs: steps with the events of their results, and the file with the traceback of a failed one
    """
    lines = []
    versions: dict[str, dict[str, None]] = {}
    for planned, events, error in logs:
        lines.append(f"{planned.step!s:<26} {_cost(planned, events)}".rstrip())
        lines += [f"    warning: {event['text']}" for event in events if event["event"] == "warning"]
        lines += [f"    it failed by a defect of the program: {error}"] if error else []
        for name, version in _versions(planned, events).items():
            versions.setdefault(name, {})[version] = None
    text = ", ".join(f"{name} {' or '.join(versions[name])}" for name in sorted(versions, key=str.lower))
    return lines + textwrap.wrap(text, 110, initial_indent="    made with ", subsequent_indent="    ")


def _cost(planned: Planned, events: list[dict]) -> str:
    done = next((event for event in reversed(events) if event["event"] == "done"), None)
    if planned.status != "current":
        return f"{planned.status}: {summarize(planned.reasons, MOST_REASONS)}"
    if done is None:
        return "its log is missing"
    cores = f"{done['threads']} thread{'s' * (done['threads'] > 1)} on {done['cores']} core{'s' * (done['cores'] > 1)}"
    cost = f"{done['seconds']:8.1f} s {done['cpu_seconds']:8.1f} s processor {done['memory_mb']:7.0f} MB peak"
    return f"{cost}   {cores}   {done['started'][:16].replace('T', ' ')} UTC"


def _versions(planned: Planned, events: list[dict]) -> dict[str, str]:
    """Return the versions of Python and of packages, and the kind of machine, of a current result."""
    if planned.status != "current":
        return {}
    machine: dict[str, str] = next((event["machine"] for event in reversed(events) if "machine" in event), {})
    versions = {"Python": machine["python"], machine["system"]: machine["processor"]} if machine else {}
    return versions | {n.removeprefix("package:"): v for n, v in planned.record.items() if n.startswith("package:")}


def parameters(params: type) -> list[tuple[str, str, str, str]]:
    """List the fields of a stage's `Params` in order: name, allowed values, default in YAML, meaning.

    The meaning is the string that follows a field.  The fields of a struct in a field have dotted names.
    """
    texts: dict[str, str] = {}
    table: list[tuple[str, str, str, str]] = []
    for cls in reversed(params.__mro__):
        if issubclass(cls, msgspec.Struct) and cls is not msgspec.Struct:
            body = list(ast.iter_child_nodes(ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]))
            for statement, following in zip(body, body[1:]):
                match statement, following:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(text)):
                        texts[name] = " ".join(str(text).split())
    for field in getattr(types.type_info(params), "fields", ()):
        if isinstance(field.type, types.StructType):
            table += [(f"{field.name}.{name}", *rest) for name, *rest in parameters(field.type.cls)]  # type: ignore[misc]
        else:
            made = field.default is msgspec.NODEFAULT and callable(field.default_factory)
            value = field.default_factory() if made else field.default
            text = "none" if value is msgspec.NODEFAULT else msgspec.json.encode(value).decode().replace(",", ", ")
            table.append((field.name, allowed(field.type), text, texts.get(field.name, "")))
    return table


def allowed(type_: Any) -> str:
    """Format the allowed values of a type of `msgspec.inspect`.

    >>> allowed(types.type_info(int)), allowed(types.IntType(ge=1, le=1024)), allowed(types.FloatType(gt=0))
    ('whole number', '1 … 1,024', 'number > 0')
    """
    if isinstance(type_, types.IntType | types.FloatType):
        if type_.ge is not None and type_.le is not None:
            return f"{type_.ge:,} … {type_.le:,}"
        bounds = ((">", type_.gt), ("≥", type_.ge), ("<", type_.lt), ("≤", type_.le))
        words = " and ".join(f"{sign} {bound:,}" for sign, bound in bounds if bound is not None)
        return f"{'whole number' if isinstance(type_, types.IntType) else 'number'} {words}".strip()
    if isinstance(type_, types.LiteralType):
        return ", ".join(str(value) for value in sorted(type_.values, key=str))
    if isinstance(type_, types.UnionType):
        return " or ".join(map(allowed, type_.types))
    if items := getattr(type_, "item_types", None):
        return f"{len(items)} of: {allowed(items[0])}"
    names: dict[type, str] = {types.BoolType: "true, false", types.StrType: "text", types.NoneType: "null"}
    return names.get(type(type_), type(type_).__name__)
