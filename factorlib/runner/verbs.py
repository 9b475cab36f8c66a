"""Verbs of the command line.  Each shows or runs the same plan, and returns the exit code."""

import contextlib
import inspect
import logging
import os
import signal
import sys
import tempfile
import textwrap
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Sized
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, NoReturn

import msgspec

from factorlib.errors import InputError
from factorlib.runner.dataset_state import DatasetState, Request, read_state
from factorlib.runner.plan import PlannedStep, Step, summarize
from factorlib.runner.project import RESERVED, Pipeline, Project, StageCode, check_name, read_pipeline
from factorlib.runner.results_folder import results_of
from factorlib.runner.store import is_locked

# exit codes as in shells
INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
STATUSES = ("current", "running", "to run", "maybe")
UNTRUSTED = 3  # exit code under STRICT=1
VERDICT = "evaluate/verdict.txt"
NO_TRUST = "do not trust"  # beginning of an adverse verdict
MAIN_RESULTS = {
    "report": "report/index.html",
    "materials": "export/materials.json",
    "environment maps": "export/illumination",
    "re-syntheses": "render/resynthesis",
}


def pipeline_of(project: Project) -> Pipeline:
    """Read the pipeline of a project."""
    return read_pipeline(project.pipeline_file, project.provider.slices)


def make(project: Project, request: Request, strict: bool = False) -> int:
    """Run the requested stages and those that they need, as far as they are not current.

    strict: return UNTRUSTED if the verdict is adverse
    """
    state = read_state(project, request)
    planned = state.plan()
    pending = [p.step for p in planned if p.status != "current"]
    if not pending:
        state.publish(planned)
        print(f"{state.data.folder.name}: nothing to do, all {len(state.records)} steps are current")
    elif code := _refuse(state, state.file_faults(pending), "files") or _run(state, planned):
        return code
    verdict = _print_results(state, request.targets is None)
    return UNTRUSTED if strict and verdict.startswith(NO_TRUST) else 0


def _print_results(state: DatasetState, whole: bool) -> str:
    """Print the places of the results, after a run of the whole pipeline those that a user looks at first.

    Returns the verdict, empty without one.
    """
    folder = state.results.folder
    short = state.project.short_path
    verdict = (folder / VERDICT).read_text(encoding="utf-8") if whole and (folder / VERDICT).exists() else ""
    if verdict:
        print(textwrap.indent(f"verdict: {verdict.rstrip()}".replace("\n", "\n  "), "  "))
    for name, path in MAIN_RESULTS.items() if whole else ():
        if (folder / path).exists():
            print(f"  {name}: {short(folder / path)}" + ("/*.exr" if (folder / path).is_dir() else ""))
    for name in state.spec.targets or ():
        over_recipes = state.spec.pipeline.stages[name].over == "recipe"
        if over_recipes or not whole:
            item = next(iter(state.recipes)) if over_recipes and len(state.recipes) == 1 else ""
            print(f"  {name}: {short(folder / name / item)}")
    return verdict


def _run(state: DatasetState, planned: list[PlannedStep]) -> int:
    from factorlib.runner.display import Display
    from factorlib.runner.run import run

    started = time.perf_counter()
    display = Display()
    try:
        if code := _refuse(state, state.parameter_faults(planned), "parameters"):
            return code
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
    completed = len(result.completed)
    seconds = time.perf_counter() - started
    print(f"{name}: {count(result.completed)} run, {len(state.records) - completed} current, {seconds:.1f} s")
    return 0


def _refuse(state: DatasetState, faults: list[str], place: str) -> int:
    """Print every fault, before anything has run; return 1 if there are any."""
    if faults:
        outcome = f"{state.data.folder.name}: {count(faults, 'fault')} in its {place}; nothing was run"
        print(*(f"error: {fault}" for fault in faults), outcome, sep="\n", file=sys.stderr)
    return 1 if faults else 0


def show_plan(project: Project, request: Request, every_reason: bool = False) -> int:
    """Print the steps that would run, with the first reasons or all; return 1 if a parameter has a wrong value."""
    state = read_state(project, request, look=True)
    planned = state.plan()
    if code := _refuse(state, state.parameter_faults(planned), "parameters"):
        return code
    print("\n".join(plan_lines(planned, every_reason)))
    return 0


def show_status(project: Project, request: Request) -> int:
    """Print the progress of each stage, the warnings of current results, and the errors of steps that failed."""
    state = read_state(project, request, look=True)
    planned = state.plan()
    counts: dict[str, Counter] = {}
    for p in planned:
        running = p.key and p.status != "current" and is_locked(state.store.locks / f"{p.key}.lock")
        counts.setdefault(p.step.stage, Counter())["running" if running else p.status] += 1
    for name, numbers in counts.items():
        print(f"{name:<10} {', '.join(f'{numbers[status]} {status}' for status in STATUSES if numbers[status])}")
    for p in planned:
        if p.status == "current" and (entry := state.store.entry(p.key)):
            print(*(f"warning: {p.step}: {text}\n" for text in entry.warnings), sep="", end="")
    failures = state.results.failures()
    for p in planned:
        if p.status != "current" and p.key in failures:
            print(f"error: {p.step}: {failures[p.key]}")
    return 0


def show_params(project: Project, stages: list[str] | None) -> int:
    """Print the parameters of the stages, or of all, as their source states them: default, range and meaning."""
    from factorlib.runner.worker import load_stage

    pipeline = pipeline_of(project)
    pipeline.check(stages or [])
    for name in stages or pipeline.order():
        params = load_stage(StageCode(project.root, project.package, name, {}, project.pipeline_file)).Params
        inner = [f.type for f in msgspec.structs.fields(params) if isinstance(f.type, type)]
        structs = [each for each in (*params.__mro__[:-1], *inner) if issubclass(each, msgspec.Struct)]
        print(f"{name}:", *(inspect.getsource(each) for each in structs if each is not msgspec.Struct), sep="\n")
        for preset, settings in pipeline.stages[name].presets.items():
            print(f"{name}.preset={preset} stands for", *(f"{name}.{key}={value}" for key, value in settings.items()))
    return 0


def validate(
    project: Project, dataset: str, settings: list[str], sheet: bool = False, held_out: Sequence[str] = ()
) -> int:
    """Check pipeline.yaml, the settings, dataset.yaml and every file that it names (first and last rows of photos).

    sheet: first write build/<dataset>/sheet.png, each photo beside its labels and meshes
    held_out: names of photos to hold out
    """
    if sheet:
        _draw_sheet(project, project.dataset_folder(dataset))
    state = read_state(project, Request(dataset, settings=settings, held_out=held_out))
    parameters_code = _refuse(state, state.parameter_faults(state.plan()), "parameters")
    if code := parameters_code or _refuse(state, state.file_faults(state.records), "files"):
        return code
    counts = f"{len(state.data.photos)} photos, {len(state.records)} steps"
    print(f"{state.data.folder.name}: pipeline.yaml, dataset.yaml and the files it names are good: {counts}")
    for caution in state.data.cautions():
        print(f"  warning: {caution}")
    print(f"next: {project.command('all', dataset)}")
    return 0


def _draw_sheet(project: Project, folder: Path) -> None:
    """Draw each photo of a dataset beside its labels and meshes; the dataset may be unfinished."""
    results = results_of(project, folder)
    results.set_owner(project, folder)
    path = results.folder / "sheet.png"
    with _shown("sheet") as progress:  # by name: it is science
        import_module("factorlib.contact_sheet").write_sheet(folder, path, partial(progress, text=""))
    print(f"  contact sheet: {project.short_path(path)}")


class EstimatedMasks(NamedTuple):
    """Options of estimated masks.

    Attributes:
        network: ONNX file of a matting network; None for that of the extra `masks`.
        whole: True for a thing of one material, whose colours are not looked at.
    """

    network: Path | None
    whole: bool


def begin(
    project: Project, dataset: str, photos: Path | None, meshes: Path | None, masks: Path | EstimatedMasks | None
) -> int:
    """Create a dataset from folders of files, and print what is left to do.

    Args:
        project: the project
        dataset: name of the dataset, or its path
        photos: folder of photos
        meshes: folder of meshes, or None
        masks: folder of masks, or None; `EstimatedMasks`: masks and cameras are estimated
    """
    if photos is None:
        cure = "add PHOTOS=<folder>, and for `make new` MASKS=<folder> and MESHES=<folder> if you have these"
        raise InputError("no folder of photos is named", key="PHOTOS", cure=cure)
    folder = Path(os.path.abspath(dataset)) if "/" in dataset else project.root / "data" / dataset
    check_name(folder.name, "a dataset", key="DATASET", reserved=RESERVED)
    with ended_by_signals(folder):
        notes = []
        if isinstance(masks, EstimatedMasks):
            with _shown("photos") as progress:  # modules by name: they are science
                create = import_module("factorlib.onboarding.from_photos").dataset_from_photos
                missing, notes = create(
                    folder, photos, meshes, masks.network, lambda share, text: progress(share, 1, text), masks.whole
                )
        else:
            missing = import_module("factorlib.dataset_draft").new_dataset(folder, photos, masks, meshes)
        ending = "; still missing, or yours to decide:" if missing else ""
        print(f"{project.short_path(folder)}/dataset.yaml is written{ending}")
        for line in (*missing, *notes):
            print(f"  {line}")
        try:
            _draw_sheet(project, folder)
        except InputError as fault:
            print(f"  no contact sheet: {fault}")
        if isinstance(masks, EstimatedMasks) and not missing:
            return validate(project, dataset, [])
        drawn = f"name your materials in it, then {project.command('label', dataset)}, then "
        first = drawn if any("make label" in line for line in missing) else ""
        print(f"next: {first}{project.command('validate', dataset)}")
        return 0


@contextlib.contextmanager
def ended_by_signals(target: Path) -> Iterator[None]:
    """End the process at SIGINT or SIGTERM, whatever handlers COLMAP has and however long its code runs.

    A thread waits for these signals, which all others block. It replaces the process by a shell, which ends them all,
    removes the temporary folders, and drafts of `target`, and exits as a shell does after the signal.
    """
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) != signal.SIG_IGN]

    def end() -> NoReturn:
        """Wait for a signal."""
        number = signal.sigwait(numbers)
        print("stopped", file=sys.stderr, flush=True)
        remove = 'code=$1; shift; rm -rf -- "$@"; exit "$code"'
        drafts = target.parent.glob(f".{target.name}.*")
        os.execvp("sh", ["sh", "-c", remove, "sh", str(128 + number), root, *map(str, drafts)])

    with tempfile.TemporaryDirectory() as root:
        tempfile.tempdir = root
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        threading.Thread(target=end, daemon=True).start()
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
            tempfile.tempdir = None


@contextlib.contextmanager
def _shown(name: str) -> Iterator[Callable[..., None]]:
    """Display the progress of the code inside, as of a step; yield its report of done, total and activity."""
    from factorlib.runner.display import Display

    step = Step(name)
    logging.disable(logging.WARNING)  # A run repeats the warnings of its photos.
    try:
        with contextlib.closing(Display()) as display:
            display.start(step)
            yield partial(display.progress, step)
    finally:
        logging.disable(logging.NOTSET)


def label_masks(project: Project, dataset: str, port: int) -> int:
    """Serve the page for drawing masks, until Ctrl-C."""
    import_module("factorlib.labelling.server").serve(project.dataset_folder(dataset), port)
    return 0


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

MOST_REASONS = 8  # reasons of one step on a line
MOST_FAILED = 20  # names of failed steps


def plan_lines(planned: list[PlannedStep], every_reason: bool = False) -> list[str]:
    """Format a plan, with one line for all steps of a stage that have the same reasons but for the photo's name.

    every_reason: add a line for each reason
    """
    groups: dict[tuple, list[str]] = {}
    for p in (p for p in planned if p.status != "current"):
        reasons = tuple(_for_any_photo(reason, p.step) for reason in p.reasons)
        groups.setdefault((p.step.stage, p.status, reasons), []).append(p.step.item)
    lines = []
    for (stage, status, reasons), items in groups.items():
        names = ", ".join(items) if len(items) <= 3 else f"{len(items)} steps"
        in_line = "" if every_reason else summarize(reasons, MOST_REASONS)
        lines.append(f"{stage:<10} {status:<7} {names:<24} {in_line}".rstrip())
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


def count(items: Sized | int, unit: str = "step") -> str:
    """Format a number, or the number of items, with its unit.

    >>> count(["a"]), count(2, "fault")
    ('1 step', '2 faults')
    """
    number = items if isinstance(items, int) else len(items)
    return f"{number} {unit}{'' if number == 1 else 's'}"
