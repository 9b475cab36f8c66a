"""The folders build/<dataset> that a user sees, and the verbs that maintain them and the store: verify and clean.

    <stage>       link to the current result of a stage, in build/store; of a stage over photos, to a view of all
    current.json  key of each step
    log.jsonl     costs, warnings and errors of all runs
    recipes/      links to the current pictures of each recipe
    dataset.txt   the dataset; only a folder with this file was made by the runner

A view, in store/views, has the files of all photos of a stage in one folder, as hard links.
"""

import contextlib
import os
import shlex
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text, read_json
from factorlib.runner.plan import Step, hash_of
from factorlib.runner.project import RESERVED, Project, check_name
from factorlib.runner.run_folder import no_runs
from factorlib.runner.store import DECODE_ERRORS, Hash, Store, stamps_of
from factorlib.wholefile import replace_file, write_text


class ResultsFolder(msgspec.Struct, frozen=True):
    """The results folder of a dataset, build/<dataset>."""

    folder: Path

    log = property(lambda self: self.folder / "log.jsonl")
    keys_file = property(lambda self: self.folder / "current.json")
    mark = property(lambda self: self.folder / "dataset.txt")

    def keys(self) -> dict[str, str]:
        """Return the key of each step's current result; InputError if the file is damaged."""
        try:
            return msgspec.json.decode(self.keys_file.read_bytes(), type=dict[str, Hash])  # a key is a part of paths
        except FileNotFoundError:
            return {}
        except DECODE_ERRORS as error:
            fault = f"does not list the current results ({getattr(error, 'strerror', None) or error})"
            cure = "delete it: the next run writes it again and finds the results in the store"
            raise InputError(fault, file=self.keys_file, cure=cure) from None

    def failures(self) -> dict[str, str]:
        """Return the error of each key that a step has failed with; damaged lines of the log are left out."""
        errors = {}
        for line in self.log.read_bytes().splitlines() if self.log.is_file() else []:
            with contextlib.suppress(*DECODE_ERRORS, KeyError):
                event = msgspec.json.decode(line, type=dict[str, Any])
                if event["event"] == "failed":
                    errors[event["key"]] = event["text"]
        return errors

    def owner(self, project: Project) -> Path | None:
        """Return the folder of the dataset whose results these are; None if dataset.txt cannot be read."""
        with contextlib.suppress(OSError):
            path = self.mark.read_text(encoding="utf-8", errors="surrogateescape").strip()
            return project.root / path if path else None
        return None

    def set_owner(self, project: Project, dataset: Path) -> None:
        """Write the dataset's folder to dataset.txt, relative to a project around it, which can then move."""
        path = dataset.relative_to(project.root) if dataset.is_relative_to(project.root) else dataset
        if self.owner(project) != project.root / path:
            self.folder.mkdir(parents=True, exist_ok=True)
            replace_file(self.mark, f"{path}\n".encode("utf-8", "surrogateescape"))


def results_of(project: Project, dataset: Path) -> ResultsFolder:
    """Return build/<name of the dataset's folder>, which may not exist yet.

    Raises:
        InputError: It is a link, or has the results of another dataset that exists.
    """
    check_name(dataset.name, "a dataset", file=dataset, key="DATASET", reserved=RESERVED)
    results = ResultsFolder(project.build / dataset.name)
    if results.folder.is_symlink():
        fault = "is a link; the runner keeps the results of a dataset in a folder"
        raise InputError(fault, file=results.folder, cure="delete the link, or move it elsewhere")
    owner = results.owner(project)
    if owner not in (None, dataset) and os.path.isdir(owner) and not (dataset.exists() and owner.samefile(dataset)):
        fault = f"two datasets are called {dataset.name!r}: build/{dataset.name} holds the results of {owner}"
        cure = f"rename one of the folders, or give up these results: make clean DATASET={shlex.quote(str(owner))}"
        raise InputError(fault, file=dataset, cure=cure)
    return results


def all_results(project: Project) -> list[ResultsFolder]:
    """Return the results folders that the runner has made in build/."""
    folders = (ResultsFolder(path) for path in sorted(project.build.glob("*")))
    return [results for results in folders if results.mark.is_file()]


def find_results(project: Project, dataset: str | None) -> list[ResultsFolder]:
    """Return the results folder of a dataset, which may be gone itself, or of all.

    Raises:
        InputError: There is neither a dataset nor a results folder.
    """
    if dataset is None:
        return all_results(project)
    folder = project.find_dataset(dataset)
    results = results_of(project, folder or Path(os.path.abspath(dataset)))
    if folder is None and not results.mark.is_file():
        known = [folder_results.folder.name for folder_results in all_results(project)]
        cure = did_you_mean(dataset, known) if known else "build/ holds no results of any dataset"
        raise InputError(f"there is no dataset {dataset!r}, and no results of one", key="DATASET", cure=cure)
    return [results] if results.mark.is_file() else []


def set_link(link: Path, target: Path, build: Path) -> None:
    """Create or replace a link to the folder `target` by one rename; inside `build` the link is relative."""
    words = os.path.relpath(target, link.parent) if target.is_relative_to(build) else str(target)
    if link.is_symlink() and os.readlink(link) == words:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    draft = link.with_name(f".{link.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    os.symlink(words, draft, target_is_directory=True)
    if link.is_dir() and not link.is_symlink():
        raise InputError("is a folder; the runner puts a link there", file=link, cure="move it elsewhere")
    os.replace(draft, link)


def make_view(store: Store, outputs: Mapping[str, str], gather: str | None) -> Path:
    """Return a folder with the files of all photos of a stage, as hard links, and create it if needed.

    `outputs` gives the hash of each photo's result.  The file `gather` has the contents of all `<photo>.json`.

    Raises:
        InputError: Two photos have a file of the same name.
    """
    view = store.views / hash_of({"photos": dict(outputs), "gather": gather})
    trees = {store.trees / output: stamps_of(store.trees / output) for output in sorted(set(outputs.values()))}
    files = {name: stamp for stamps in trees.values() for name, stamp in stamps.items()}
    present = stamps_of(view)
    gathered = present.keys() & {gather}
    if bool(gathered) == bool(gather) and files == {name: present[name] for name in present.keys() - gathered}:
        return view
    draft = store.tmp / f"view-{uuid.uuid4().hex[:8]}-{view.name}"
    for source in (tree / name for tree, stamps in trees.items() for name in stamps):
        target = draft / Path(*source.relative_to(store.trees).parts[1:])
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            shutil.rmtree(draft, ignore_errors=True)
            fault = f"two photos write the same file {target.name!r}"
            raise InputError(fault, file=source, cure="put the photo's name into the file's name")
        try:
            os.link(source, target)
        except OSError:  # no hard links on this file system
            shutil.copy2(source, target)
    if gather:
        write_text(draft / gather, json_text({photo: read_json(draft / f"{photo}.json") for photo in sorted(outputs)}))
        (draft / gather).chmod(0o444)
    store.views.mkdir(exist_ok=True)
    store.set_aside(view)
    with contextlib.suppress(OSError):  # Another run was faster.
        os.rename(draft, view)
    return view


# ── verify and clean ─────────────────────────────────────────────────────────────────────────────────────────────────


def verify(project: Project, dataset: str | None) -> int:
    """Read every stored result, of a dataset or of all, and list damaged ones; return 1 if there are any.

    The next run that needs a damaged result makes it again.
    """
    store = Store(project.store)
    keys = {key for results in find_results(project, dataset) for key in results.keys().values()}
    keys |= set() if dataset else {path.stem for path in store.keys.glob("*.json")}
    damaged = 0
    for key in sorted(keys):
        entry = store.entry(key)
        place = store.trees / entry.output if entry else store.keys / f"{key}.json"
        faults = store.faults(entry, reread=True) if entry else ["missing, not readable, or not of this key"]
        if faults:
            damaged += 1
            record = entry.record if entry else {"stage": "a result"}
            name = Step(record["stage"], record.get("photo"), record.get("recipe"))
            print(f"{name}: {project.short_path(place)}", *faults, sep="\n    ")
    store.hashes.save()
    outcome = f"{damaged} damaged; the next run that needs one makes it again" if damaged else "all are sound"
    print(f"{len(keys)} results read: {outcome}")
    return 1 if damaged else 0


def clean(project: Project, dataset: str | None) -> int:
    """Delete the results folder of a dataset, or all of them and the store of this checkout.

    The results of one dataset stay in the store.
    """
    deleted = [results.folder for results in find_results(project, dataset)]
    store = Store(project.store)
    if (
        dataset is None
        and store.root == project.build / "store"
        and store.root.is_dir()
        and not store.root.is_symlink()
    ):
        deleted.append(store.root)
    with no_runs(store) if deleted else contextlib.nullcontext():
        for folder in deleted:
            shutil.rmtree(folder)
            print(f"deleted {project.short_path(folder)}")
    print("" if deleted else "nothing to delete\n", end="")
    return 0
