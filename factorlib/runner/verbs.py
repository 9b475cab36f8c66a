"""What each verb does; every one of them shows or runs the same plan.  Returns the exit code."""

from __future__ import annotations

import fcntl
import os
import shlex
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner import words
from factorlib.runner.checks import faults, new_faults, wrong_values
from factorlib.runner.finish import label, remember, results
from factorlib.runner.home import Home, claim, made_home, made_homes
from factorlib.runner.logs import sound_lines, warnings_in
from factorlib.runner.names import RESERVED, check_name
from factorlib.runner.params import parameters
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.plan import Planned, difference
from factorlib.runner.project import Project, is_path
from factorlib.runner.recipes import ALL
from factorlib.runner.shared import has, shared_store
from factorlib.runner.stop import INTERRUPTED, TERMINATED, Stopped, heed_stops
from factorlib.runner.store import Store
from factorlib.runner.survey import Survey, survey
from factorlib.runner.worker import Code, load_stage
from factorlib.wholefile import write_text

if TYPE_CHECKING:
    from factorlib.runner.drawing import State

RENDER = "render"  # the stage whose pictures a recipe replaces


class Wish(msgspec.Struct, frozen=True):
    """What the command line asks for.

    targets:  stages; None for all but those that run only when asked for
    settings: `stage.parameter=value`;  force: run the targets again, whatever the store holds
    recipes:  paths, names or `all`: stages over recipes make their pictures
    """

    dataset: str
    targets: list[str] | None = None
    settings: list[str] = []
    force: bool = False
    recipes: list[str] = []


def make(project: Project, wish: Wish) -> int:
    """Run the stages that are wanted and what they need, as far as anything must run."""
    with heed_stops():
        return _make(project, wish)


def surveyed(project: Project, wish: Wish) -> Survey:
    """The survey of what is wanted.  Recipes add the stages over them; with the target `render` they are all that is wanted."""
    stages = read_pipeline(project.pipeline_file, project.provider.slices).stages
    over_recipes = [name for name, stage in stages.items() if stage.over == "recipe"]
    targets, recipes = wish.targets, wish.recipes
    if recipes:
        usual = [name for name, stage in stages.items() if not stage.optional] if targets is None else targets
        targets = over_recipes if targets == [RENDER] else [*usual, *over_recipes]
    elif any(name in over_recipes for name in targets or []):
        recipes = [ALL]
    return survey(project, wish.dataset, targets, wish.settings, wish.force, recipes)


def _make(project: Project, wish: Wish) -> int:
    started = time.perf_counter()
    seen = surveyed(project, wish)
    whole = wish.targets is None
    planned = seen.planned()
    if all(p.status == "current" for p in planned):
        remember(seen, planned=planned)
        print(f"{seen.data.folder.name}: nothing to do, all {len(seen.records)} steps are current")
        _name_results(seen, whole)
        return 0
    if found := new_faults(seen, planned):
        return _refused(seen, found)
    return _run(seen, whole, started)


def check_stage(project: Project, name: str, verbs: list[str]) -> None:
    """A word from the command line that is no verb must be the name of a stage."""
    stages = read_pipeline(project.pipeline_file, project.provider.slices).stages
    if name not in stages:
        raise InputError(f"there is no verb or stage {name!r}", cure=did_you_mean(name, [*stages, *verbs]))


def _run(seen: Survey, whole: bool, started: float) -> int:
    from factorlib.runner.run import Refused, run
    from factorlib.runner.screen import display_for

    display = display_for()
    try:
        tally = run(seen, display)
    except Refused:
        return 1
    except (KeyboardInterrupt, Stopped) as stop:
        display.say("stopped; what was finished is kept, the next run goes on from there")
        return TERMINATED if isinstance(stop, Stopped) else INTERRUPTED
    finally:
        display.close()
    if tally.failed:
        failed = list(tally.failed)
        print(f"{seen.data.folder.name}: {words.count(failed)} failed: {words.listed(failed)}")
        if tally.held_up:
            print(f"not run for that: {', '.join(dict.fromkeys(step.stage for step in tally.held_up))}")
        return 1
    print(
        f"{seen.data.folder.name}: {words.count(tally.ran)} run, {len(seen.records) - len(tally.ran)} current, {time.perf_counter() - started:.1f} s"
    )
    _name_results(seen, whole)
    return 0


def _name_results(seen: Survey, whole: bool) -> None:
    """Of the whole pipeline what a user looks at first, else the folder of each stage; pictures of recipes either way."""
    for what, path in results(seen) if whole else ():
        shown = seen.project.shown(path)
        print(f"  {what}: {shown}" + ("/*.exr" if path.is_dir() else ""))
    for name in seen.spec.targets or ():
        over_recipes = seen.spec.pipeline.stages[name].over == "recipe"
        if over_recipes or not whole:
            folder = seen.home.folder / name
            print(f"  {name}: {seen.project.shown(folder / next(iter(seen.recipes)) if over_recipes and len(seen.recipes) == 1 else folder)}")


def show_plan(project: Project, wish: Wish) -> int:
    """Print what would run; 1 where a value of a parameter would not do."""
    return _shown(project, wish, words.plan_lines)


def show_why(project: Project, wish: Wish) -> int:
    """Print why each step would run; 1 where a value of a parameter would not do."""
    return _shown(project, wish, words.why_lines)


def _shown(project: Project, wish: Wish, lines: Callable[[list[Planned]], list[str]]) -> int:
    seen = _looked_at(project, wish)
    planned = seen.planned()
    if found := wrong_values(seen, planned):
        return _refused(seen, found, "parameters")
    if folder := shared_store(seen.store.root):
        planned = [_with_shared(p, Store(folder)) for p in planned]
    print("\n".join(lines(planned)))
    return 0


def _with_shared(planned: Planned, shared: Store) -> Planned:
    """With a word of it where a step need only be copied."""
    if planned.status == "current" or planned.key is None or "forced" in planned.reasons or not has(shared, planned.key):
        return planned
    return msgspec.structs.replace(planned, reasons=[*planned.reasons, "the shared store has it"])


def _looked_at(project: Project, wish: Wish) -> Survey:
    """The survey of what is wanted, without running it: where recipes are named and no stage, of the recipes alone."""
    targets = [RENDER] if wish.recipes and wish.targets is None else wish.targets
    return surveyed(project, msgspec.structs.replace(wish, targets=targets))


def show_status(project: Project, wish: Wish) -> int:
    """Print how far each stage is, and its warnings."""
    seen = _looked_at(project, wish)
    print("\n".join(words.status_lines(seen.planned(), lambda p: is_running(seen, p), lambda p: warnings_of(seen, p))))
    return 0


def is_running(seen: Survey, planned: Planned) -> bool:
    """Whether a run holds the lock on a step's key."""
    try:
        descriptor = os.open(seen.store.locks / f"{planned.key}.lock", os.O_RDONLY)  # that needs no right to write
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)


def warnings_of(seen: Survey, planned: Planned) -> list[str]:
    """What a step said when its present result was made."""
    return warnings_in(seen.store.log(planned.key))


def show_graph(project: Project, mermaid: bool = False, svg: Path | None = None, wish: Wish | None = None) -> int:
    """Print the stages and what each takes, as text or as a Mermaid diagram, or draw them.

    svg: file to draw to;  wish: with a data set the drawing has its numbers of photos, and how far each stage is
    """
    pipeline = read_pipeline(project.pipeline_file, project.provider.slices)
    if svg is not None:
        from factorlib.runner.drawing import drawing

        if svg.suffix.lower() != ".svg":
            raise InputError("is no name of an SVG file", file=svg, key="SVG", cure="name one, as in SVG=build/graph.svg")
        svg.parent.mkdir(parents=True, exist_ok=True)
        write_text(svg, drawing(pipeline, states_of(surveyed(project, wish)) if wish else None))
        print(f"graph: {project.shown(svg)}")
        return 0
    print("\n".join(words.mermaid_lines(pipeline) if mermaid else words.graph_lines(pipeline)))
    return 0


def states_of(seen: Survey) -> dict[str, State]:
    """How far each stage of a survey is, for a drawing."""
    from factorlib.runner.drawing import State

    planned: dict[str, list[str]] = {}
    for p in seen.planned():
        planned.setdefault(p.step.stage, []).append("running" if p.key and p.status != "current" and is_running(seen, p) else p.status)
    return {stage: State(len(found), {status: found.count(status) for status in dict.fromkeys(found)}) for stage, found in planned.items()}


def show_logs(project: Project, wish: Wish, photo: str | None) -> int:
    """Print what the current results of stages cost, said and were made with; of one photo or recipe, or of all."""
    seen = _looked_at(project, wish)
    found = [p for p in seen.planned() if (not wish.targets or p.step.stage in wish.targets) and photo in (None, p.step.of)]
    if not found:
        known = [name for name in [*seen.data.photos, *seen.recipes] if name]
        raise InputError(f"no step is of {photo!r}", key="PHOTO", cure=did_you_mean(str(photo), known))
    print("\n".join(words.log_lines([_logged(seen, p) for p in found])))
    return 0


def _logged(seen: Survey, planned: Planned) -> words.Logged:
    events = [msgspec.json.decode(line) for line in sound_lines(seen.store.log(planned.key))] if planned.status == "current" else []
    error = seen.home.errors / f"{label(planned.step)}.txt"
    return words.Logged(planned, events, seen.project.shown(error) if error.is_file() else None)


def show_params(project: Project, stages: list[str] | None) -> int:
    """Every parameter of the stages, or of all, with default, range and meaning."""
    pipeline = read_pipeline(project.pipeline_file, project.provider.slices)
    for number, name in enumerate(stages or pipeline.order()):
        check_stage(project, name, [])
        code = Code(project.root, project.package, name, {}, project.pipeline_file)
        lines = words.parameter_lines(name, parameters(load_stage(code).Params))
        print("\n".join([""] * (number > 0) + lines))
    return 0


def begin(project: Project, dataset: str, photos: Path | None, masks: Path | None, meshes: Path | None) -> int:
    """Make a new dataset of folders of files, and say what is left to do."""
    if photos is None:
        raise InputError("no folder of photos is named", key="PHOTOS", cure="add PHOTOS=<folder>, and MASKS=… and MESHES=… where there are some")
    folder = Path(os.path.abspath(dataset)) if is_path(dataset) else project.root / "data" / dataset
    check_name(folder.name, "a dataset", key="DATASET", reserved=RESERVED)
    missing = import_module("factorlib.newset").new_dataset(folder, photos, masks, meshes)  # by its name, as stages: it imports science
    print(f"{project.shown(folder)}/dataset.yaml is written" + (", with `?` where you must say more:" if missing else ""))
    print("\n".join([*(f"  {line}" for line in missing), f"next: make validate DATASET={shlex.quote(dataset)}"]))
    return 0


def compare(project: Project, first: Path, second: Path) -> int:
    """Write a page that shows two results, folders such as build/eames, side by side."""
    folders = [path if path.is_dir() else project.build / path for path in (first, second)]
    for folder, named in zip(folders, (first, second), strict=True):
        if not Home(folder).keys_file.is_file():
            known = [str(home.folder.name) for home in made_homes(project)]
            cure = did_you_mean(str(named), known) if known else "make all DATASET=<name> makes one"
            raise InputError("there is no result here", file=named, key="compare", cure=cure)
    changes = _changes(Store(project.build / "store"), *map(Home, folders))
    page = import_module("factorlib.report.comparison").comparison(*folders, changes)  # by its name, as stages: it imports science
    path = project.build / "compare" / f"{folders[0].name}-{folders[1].name}" / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, page)
    print(f"comparison: {project.shown(path)}")
    return 0


def _changes(store: Store, first: Home, second: Home) -> list[str] | None:
    """Between the records of the steps that both have, each once; None where the store no longer has one.  Results of other steps are left out."""
    keys = [home.keys() for home in (first, second)]
    found: dict[str, None] = {}
    for step in keys[0].keys() & keys[1].keys():
        entries = [store.entry(each[step]) for each in keys]
        if None in entries:
            return None
        records = [{name: value for name, value in entry.record.items() if not name.startswith("input:")} for entry in entries]
        found |= dict.fromkeys(f"{step.partition('/')[0]}: {change}" for change in difference(*records))
    return sorted(found)


def validate(project: Project, dataset: str, settings: list[str], sheet: bool = False) -> int:
    """Check pipeline.yaml, the settings, dataset.yaml and every file it names, of photos only their headers.

    sheet: also write build/<dataset>/sheet.png, each photo beside its labels and meshes
    """
    seen = survey(project, dataset, None, settings)
    if found := wrong_values(seen, seen.planned()):
        return _refused(seen, found, "parameters")
    if found := faults(seen, seen.records):
        return _refused(seen, found)
    print(
        f"{seen.data.folder.name}: pipeline.yaml, dataset.yaml and the files it names are good: "
        f"{len(seen.data.photos)} photos, {len(seen.records)} steps"
    )
    if sheet:
        claim(project, seen.home, seen.data.folder)
        path = seen.home.folder / "sheet.png"
        from factorlib.runner.screen import shown_if_long

        with shown_if_long("sheet") as report:
            import_module("factorlib.sheet").write_sheet(seen.data.folder, path, report)  # by its name, as stages: it imports science
        print(f"  contact sheet: {project.shown(path)}")
    return 0


def _refused(seen: Survey, found: list[InputError], where: str = "files") -> int:
    """Every fault at once, before anything has run."""
    for fault in found:
        print(f"error: {fault}", file=sys.stderr)
    print(f"{seen.data.folder.name}: {len(found)} {'fault' if len(found) == 1 else 'faults'} in its {where}; nothing was run", file=sys.stderr)
    return 1


def clean(project: Project, dataset: str | None) -> int:
    """Forget the results of one dataset, or of all, and say what was deleted."""
    from factorlib.runner.gc import forget, forget_all

    home = None if dataset is None else made_home(project, dataset)
    if dataset is not None and home is None:
        print(f"nothing to delete: {dataset} has no results")
        return 0
    gone = forget_all(project) if home is None else forget(project, home)
    print("\n".join(gone.lines(project.shown)))
    return 0


def collect(project: Project, agreed: Callable[[], bool]) -> int:
    """Show which results in the store no data set names, and delete them where that is `agreed`, which is asked after they are shown."""
    from factorlib.runner.gc import collect as delete_unused
    from factorlib.runner.gc import unneeded

    found = unneeded(project)
    for line in words.unneeded_lines(found, time.time()):
        print(line)
    if found and not agreed():
        print("nothing was deleted")
        return 0
    freed = delete_unused(project)
    print(f"deleted {freed.results} results that nothing names any more, {freed.bytes / 1e6:.1f} MB")
    return 0


def verify(project: Project, dataset: str | None) -> int:
    """Read every result, of a dataset or of all; 1 where any is not as it was kept."""
    from factorlib.runner.verify import verify as read_all

    home = None if dataset is None else made_home(project, dataset)
    if dataset is not None and home is None:
        print(f"nothing to read: {dataset} has no results")
        return 0
    homes = made_homes(project) if home is None else [home]
    pipeline = read_pipeline(project.pipeline_file, project.provider.slices)
    verdict = read_all(Store(project.build / "store"), homes, pipeline, everything=home is None)
    print("\n".join(words.damage_lines(verdict, project.shown)))
    return 1 if verdict.damaged else 0


def ship(project: Project, stage: str, dataset: str) -> int:
    """Put the current result of a stage into the package, where pipeline.yaml says that it ships with the source."""
    from factorlib.runner.shipped import ship as put

    stages = read_pipeline(project.pipeline_file, project.provider.slices).stages
    known = [name for name, found in stages.items() if found.shipped]
    if stage not in known:
        raise InputError(f"no result of {stage!r} ships with the source", key="ship", cure=did_you_mean(stage, known))
    seen = survey(project, dataset, [stage], [])
    planned = next(p for p in seen.planned() if p.step.stage == stage)
    if planned.status != "current":
        raise InputError(f"{stage!r} has no current result", key="ship", cure=f"make {stage} DATASET={dataset} FORCE=1")
    print(f"{stage}: {project.shown(put(seen.store.tree(planned.output), planned.record, project.root, stages[stage].shipped))}")
    return 0
