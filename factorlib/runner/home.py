"""The folders that a user sees: build/<dataset>, with links to the current results, marks, and the log of all runs.

    <stage>       link to the current result of a stage, in build/store; for a stage over photos, to a view
    current.json  which key each step and each view has
    log.jsonl     what all runs did
    errors/       where a step failed by a defect, its traceback
    recipes/      links to the current pictures of each recipe
    dataset.txt   whose results these are: only a folder with this mark is a home that the runner made

A view is one more result: those of all photos of a stage in one folder, by hard links.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text, read_json
from factorlib.runner.filehash import hash_of_file
from factorlib.runner.plan import Planned, Step, hash_of
from factorlib.runner.project import RESERVED, Project, check_name
from factorlib.runner.store import Store, damage_of, stamps_of
from factorlib.wholefile import replace_file, write_text

if TYPE_CHECKING:
    from factorlib.runner.survey import Survey

log = logging.getLogger("factorlib.runner")
Key = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]  # it becomes a part of paths
LONGEST = 85  # bytes of the name of a step's files, to which suffixes are added


class Home(msgspec.Struct, frozen=True):
    """One such folder, directly in build/."""

    folder: Path

    log = property(lambda self: self.folder / "log.jsonl")
    keys_file = property(lambda self: self.folder / "current.json")
    mark = property(lambda self: self.folder / "dataset.txt")
    errors = property(lambda self: self.folder / "errors")

    def keys(self, lenient: bool = False) -> dict[str, str]:
        """Step -> key of its current result, nothing where there is none; InputError where the file is damaged.

        lenient: then a warning, and nothing
        """
        try:
            return msgspec.json.decode(self.keys_file.read_bytes(), type=dict[str, Key])
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            words = f"does not say which results are current ({getattr(error, 'strerror', None) or error})"
            cure = "delete it: the next run writes it anew and finds the results that are in the store"
            fault = InputError(words, file=self.keys_file, cure=cure)
            if not lenient:
                raise fault from error
            log.warning("%s; nothing is lost, but it is not known what changed since the last run", fault)
            return {}


def home_of(project: Project, dataset: Path, by_name: bool = False) -> Home:
    """build/<name of the dataset's folder>; refused where that is a link, or holds the results of another folder.

    by_name: whoever's results it holds
    """
    check_name(dataset.name, "a dataset", file=dataset, key="DATASET", reserved=RESERVED)
    home = Home(project.build / dataset.name)
    if os.path.realpath(home.folder) != os.path.join(os.path.realpath(project.build), dataset.name):
        words = "is a link, where the runner keeps a dataset's results"
        raise InputError(words, file=home.folder, cure="delete the link, or move it elsewhere")
    owner = None if by_name else owner_of(project, home)
    if owner not in (None, dataset) and not (
        os.path.isdir(dataset) and (not os.path.isdir(owner) or owner.samefile(dataset))
    ):
        words = f"two datasets are called {dataset.name!r}: build/{dataset.name} holds the results of {owner}"
        cure = f"rename one of the folders, or give its results up: make clean DATASET={shlex.quote(str(owner))}"
        raise InputError(words, file=dataset, cure=cure)
    return home


def made_home(project: Project, dataset: str) -> Home | None:
    """The home with results of a dataset by its name or path, which need not be there any more; None where it has none yet.

    A name is that of a home in build/; a path must be the one that the home was made for.  InputError for whatever else.
    """
    there = project.find_dataset(dataset)
    home = home_of(project, there or Path(os.path.abspath(dataset)), by_name=there is None and "/" not in dataset)
    if home.mark.is_file():
        return home
    if there is None:
        known = [other.folder.name for other in made_homes(project)]
        cure = did_you_mean(dataset, known) if known else "build/ holds no results of any dataset"
        raise InputError(f"there is no dataset {dataset!r}, and no results of one", key="DATASET", cure=cure)
    return None


def made_homes(project: Project) -> list[Home]:
    """Every home that the runner made; links are not followed."""
    entries = sorted(project.build.iterdir()) if project.build.is_dir() else []
    homes = [Home(path) for path in entries if path.is_dir() and not path.is_symlink() and path.name not in RESERVED]
    return [home for home in homes if home.mark.is_file()]


def owner_of(project: Project, home: Home) -> Path | None:
    """The dataset whose results these are; None where nothing says it."""
    with contextlib.suppress(OSError):
        words = home.mark.read_text(encoding="utf-8", errors="surrogateescape").removesuffix("\n")
        return project.root / words if words else None
    return None


def claim(project: Project, home: Home, dataset: Path) -> None:
    """Write down whose results these are: relative to the project where the dataset lies in it, for checkouts move."""
    home.folder.mkdir(parents=True, exist_ok=True)
    words = str(dataset.relative_to(project.root)) if dataset.is_relative_to(project.root) else str(dataset)
    if owner_of(project, home) != project.root / words:
        replace_file(home.mark, f"{words}\n".encode("utf-8", "surrogateescape"))


def remember(survey: Survey, made: dict[str, str]) -> None:
    """Write down the keys that steps have now; steps of photos and stages that are no more are dropped."""
    stages, before = survey.spec.pipeline.stages, survey.home.keys(lenient=True)
    names = {*stages, *(str(step) for stage in stages for step in survey.spec.steps_of(stage))}
    asked_for_before = tuple(f"{name}/" for name, stage in stages.items() if stage.over == "recipe")
    keys = {name: key for name, key in before.items() if name in names or name.startswith(asked_for_before)} | made
    if keys != before:
        claim(survey.project, survey.home, survey.data.folder)
        replace_file(survey.home.keys_file, json_text(keys).encode())


def show(survey: Survey, planned: list[Planned]) -> None:
    """Write down what is current and point the links there: of a stage over photos, at one folder with all of them."""
    home, store, stages = survey.home, survey.store, survey.spec.pipeline.stages
    current = {p.step: p for p in planned if p.status == "current"}
    keys, of_photos = {str(step): p.key for step, p in current.items()}, {}
    for step, p in current.items():
        if step.photo:
            of_photos.setdefault(step.stage, {})[step.photo] = p.key
        else:
            point(home.folder / str(step), store.trees / p.output)
    for name, of in of_photos.items():
        keys[name] = view_of(store, name, of, stages[name].gather)
        point(home.folder / name, store.trees / store.get(keys[name]))
    remember(survey, keys)
    for link in home.folder.glob("[!.]*"):  # hidden ones are drafts of links, of another run perhaps
        if link.is_symlink() and link.name not in stages:
            link.unlink(missing_ok=True)
    failed = {label(step) for stage in stages for step in survey.spec.steps_of(stage) if step not in current}
    for path in (path for path in home.errors.glob("*.txt") if path.stem not in failed):
        path.unlink(missing_ok=True)  # what is written of a failure goes with success, or with the step
    with contextlib.suppress(OSError):  # what is not empty stays; another run may have removed the folder
        home.errors.rmdir()
    store.save()


def label(step: Step) -> str:
    """The name of a step's own files, short however long the photo's name is.

    >>> label(Step("masks", "kitchen")), len(label(Step("masks", "k" * 240)))
    ('masks-kitchen', 70)
    """
    name = str(step).replace("/", "-")
    return name if len(name.encode()) <= LONGEST else f"{step.stage[:20]}-{hashlib.sha256(name.encode()).hexdigest()}"


def point(link: Path, target: Path) -> None:
    """Make `link` name the folder `target` from one moment to the next; relative, so that build/ can be moved."""
    words = os.path.relpath(target, link.parent)
    if link.is_symlink() and os.readlink(link) == words:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    draft = link.with_name(f".{link.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    os.symlink(words, draft, target_is_directory=True)
    if link.is_dir() and not link.is_symlink():
        raise InputError("is a folder of its own, where the runner puts a link", file=link, cure="move it elsewhere")
    os.replace(draft, link)


def view_of(store: Store, stage: str, keys: dict[str, str], gather: str | None) -> str:
    """The key of one folder with the files of all photos of a stage ({photo: key}), and each `<photo>.json` in `gather`.

    The folder is a result as those of steps are.  Its files are hard links to theirs.
    """
    entries = {photo: store.entry(key) for photo, key in sorted(keys.items())}
    record = {f"input:{stage}/{photo}": entry.output for photo, entry in entries.items()}
    record |= {"stage": stage, "photo": None, "view": gather}
    if store.get(key := hash_of(record)) is not None:
        return key
    draft, files, right = store.tmp / f"view-{os.getpid()}-{key}", {}, {}
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    try:
        for photo, entry in entries.items():
            for name in entry.files:
                if name in files:
                    words = f"two photos write the same file {name!r}"
                    raise InputError(words, key=photo, cure="put the photo's name into it")
                (draft / name).parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(store.trees / entry.output / name, draft / name)
                except OSError:  # no hard links on this file system
                    shutil.copy2(store.trees / entry.output / name, draft / name)
            files, right = files | entry.files, right | store.known.get(entry.output, {})
        if damage := damage_of(draft, files, right):  # a result that was spoilt since it was looked at
            cure = "run again: it is made anew"
            raise InputError(f"a result was spoilt meanwhile: {damage[0]}", key=stage, cure=cure)
        if gather:
            table = {photo: read_json(draft / f"{photo}.json") for photo in entries}
            write_text(draft / gather, json_text(table))
            (draft / gather).chmod(0o444)
            files[gather] = hash_of_file(draft / gather)
        view = store.take_in(record, draft, log.warning, files)
        store.keep(key, view)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    store.forget(key)
    store.known[view.output], store.changed = stamps_of(store.trees / view.output), True
    return key


def usual_costs(log_file: Path) -> dict[str, tuple[float, int]]:
    """Return by stage, of the steps as they were last made, the mean of their seconds, and the most cores that one took."""
    last: dict[str, dict[str | None, tuple[float, int]]] = {}
    for event in map(msgspec.json.decode, sound_lines(log_file)):
        if event["event"] == "done" and {"seconds", "cores", "threads"} <= event.keys():
            cost = event["seconds"], max(event["cores"], event["threads"])
            last.setdefault(event["stage"], {})[event.get("photo")] = cost
    costs = {stage: list(zip(*of.values())) for stage, of in last.items()}
    return {stage: (sum(seconds) / len(seconds), max(cores)) for stage, (seconds, cores) in costs.items()}


def sound_lines(path: Path) -> list[bytes]:
    """The lines of a log that are events, in order, none where there is no log; damaged ones are left out, with a warning."""
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return []
    sound = []
    for line in lines:
        with contextlib.suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            event = msgspec.json.decode(line, type=dict)
            sound += [line] if isinstance(event.get("event"), str) else []
    if len(sound) < len(lines):
        words = "%s: %d damaged lines are left out; the results are not affected"
        log.warning(words, path, len(lines) - len(sound))
    return sound
