"""What a plan is made from: each step's own record, from the sources, the dataset and the installed packages."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain
from factorlib.runner.closure import Packages, Sources, other_than, recorded
from factorlib.runner.filehash import FileHashes
from factorlib.runner.home import Home, home_of
from factorlib.runner.pipeline import (
    DATASET,
    check_values,
    read_pipeline,
    said_of_settings,
    with_settings,
    words_by_key,
)
from factorlib.runner.plan import Listing, Planned, Record, Spec, Step, plan
from factorlib.runner.project import Data, Project, Recipe
from factorlib.runner.store import Inspector, Store
from factorlib.runner.worker import Code, check_params

READ = (
    "file:",
    "recipe file:",
    f"facts:{DATASET}",
)  # fields of a record: the part of the dataset and recipe that a step reads


@dataclass
class Survey:
    """All that is known before anything runs; `planned` is what every verb shows.

    records:  each step's record but for the results it is handed
    recipes:  those that are asked for, by name
    previous: the record each step had when it last was current for this dataset
    words:    settings of the command line, by the keys of pipeline.yaml that they stand for
    """

    project: Project
    data: Data
    home: Home
    store: Store
    spec: Spec
    records: dict[Step, Record]
    outputs: Inspector
    previous: dict[str, Record]
    recipes: dict[str, Recipe]
    words: dict[str, str]

    def planned(self, forced: frozenset[Step] | None = None) -> list[Planned]:
        """Every step with its state and the reason for it; `forced` replaces the spec's steps that must run."""
        spec = self.spec if forced is None else msgspec.structs.replace(self.spec, forced=forced)
        return plan(spec, self.records, Listing(self.outputs, self.previous, self.outputs.damaged))

    def code(self, name: str, cores: int = 1) -> Code:
        """A stage with its parameters, as a worker loads it; cores: of the machine, of which it takes what it may."""
        stage, project = self.spec.pipeline.stages[name], self.project
        taken = cores if stage.cores == "all" else min(stage.cores, cores)
        file, words = project.pipeline_file, self.words
        return Code(project.root, project.package, name, stage.values, file, stage.threads, taken, words)

    def faults(self, steps: Iterable[Step], new: bool = False) -> list[str]:
        """What is wrong with the files that steps read, those of their recipes too, each fault once.

        Where several stages take a slice, it is looked at by the parameters of the first.
        new: only where the step's part of the dataset, or a file of its recipe, is another than that of its last result
        """
        faults, done = {}, set()
        for step in steps:
            stage, before = self.spec.pipeline.stages[step.stage], self.previous.get(str(step))
            now = {name: value for name, value in self.records[step].items() if name.startswith(READ)}
            if new and before is not None and now == {k: v for k, v in before.items() if k.startswith(READ)}:
                continue
            errors = self.data.recipe_faults(self.recipes[step.recipe].files) if step.recipe is not None else []
            for slice_ in stage.slices:
                if (slice_, step.photo) not in done:
                    done.add((slice_, step.photo))
                    errors = [*errors, *self.data.faults(slice_, step.photo, stage.values, self.project.pipeline_file)]
            faults |= dict.fromkeys(map(str, errors))
        return list(faults)

    def wrong_values(self, planned: list[Planned]) -> list[str]:
        """Of the parameters that steps would run with: one out of its range, or of another kind.

        Only a stage that is given any is imported, in a process of its own: that takes seconds where it computes.
        """
        open_ = dict.fromkeys(p.step.stage for p in planned if p.status != "current")
        codes, faults = [self.code(name) for name in open_ if self.spec.pipeline.stages[name].values], []
        if codes:
            from factorlib.runner.child import Pools

            pools = Pools()
            try:
                for future in [pools.submit(1, code.threads, check_params, code) for code in codes]:
                    if future.exception() is None and not (outcome := future.result()).traceback:
                        faults += filter(None, [outcome.error])  # a stage that cannot be loaded says so when it is run
            finally:
                pools.close(kill=True)
        return faults


def survey(
    project: Project,
    dataset: str,
    targets: list[str] | None,
    settings: list[str],
    force: bool = False,
    recipes: list[str] | None = None,
) -> Survey:
    """Read everything a plan needs; every InputError there is about pipeline, settings, dataset or recipes comes from here.

    recipes: paths or names of those that are asked for; without any, stages over recipes have no steps
    """
    file, words = project.pipeline_file, words_by_key(settings)
    pipeline = with_settings(read_pipeline(file, project.provider.slices), settings)
    with _said_of(words):
        check_values(pipeline, file)
    for name in (name for name in targets or [] if name not in pipeline.stages):
        raise InputError(f"there is no stage {name!r}", file=file, cure=did_you_mean(name, pipeline.stages))
    data = project.provider.read(project.dataset_folder(dataset))
    home, store = home_of(project, data.folder), Store(project.build / "store")
    asked = project.recipes(data, recipes or [])
    spec = Spec(pipeline, data.photos, targets, recipes=list(asked))
    if force:
        forced = pipeline.stages if targets is None else targets
        spec = msgspec.structs.replace(spec, forced=frozenset(step for name in forced for step in spec.steps_of(name)))
    hashes = FileHashes(store.cache / "files.json")
    with _said_of(words):
        records = _records(project, spec, data, hashes, Packages(store.cache / "packages.json"), asked)
    with contextlib.suppress(OSError):  # of a build/ that is read-only: the next command reads more, that is all
        hashes.save()
    outputs = Inspector(store)
    entries = {step: outputs.entry(key) for step, key in home.keys(lenient=True).items()}
    previous = {step: entry.record for step, entry in entries.items() if entry}
    return Survey(project, data, home, store, spec, records, outputs, previous, asked, words)


@contextlib.contextmanager
def _said_of(words: dict[str, str]) -> Iterator[None]:
    """What is wrong with a setting is said of the setting."""
    try:
        yield
    except InputError as error:
        raise said_of_settings(error, words) from None


def _records(
    project: Project, spec: Spec, data: Data, hashes: FileHashes, packages: Packages, recipes: dict[str, Recipe]
) -> dict[Step, Record]:
    sources, stages, file = Sources(project.source_roots, hashes), spec.pipeline.stages, project.pipeline_file
    wanted = spec.pipeline.needed(spec.targets)
    defaults = {
        name: sources.stage_params(project.package, name, file)
        for name, stage in stages.items()
        if stage.params or name in wanted
    }
    for name, stage in (
        (name, stages[name]) for name in defaults
    ):  # names alone: values are checked where it is loaded
        known = [*defaults[name], *stage.given]
        for param in (param for param in stage.params if param not in known):
            words, cure = f"the stage {name!r} has no parameter {param!r}", did_you_mean(param, known)
            raise InputError(
                words, file=file, key=f"stages.{name}.params.{param}", cure=cure if known else "leave it out"
            )
    records = {}
    for name in wanted:
        stage, closure = stages[name], sources.closure(project.package, name, file)
        values = other_than(defaults[name], stage.values)
        record = {"stage": name, "threads": stage.threads, "makes": stage.makes}
        record |= {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"} | closure.record()
        record |= {f"package:{package}": version for package, version in packages.versions(closure.external).items()}
        record |= {f"param:{param}": value for param, value in values.items()}
        record |= {f"default:{param}": recorded(value) for param, value in defaults[name].items()}
        for param, folder in stage.folders.items():
            for given in stage.given[param]:
                words = f"name a folder with {', '.join(stage.given[param])}, such as the result of an earlier run of the stage"
                record[f"given:{param}/{given}"] = _given(project, folder, given, f"{name}.{param}", words, hashes)
        for step in spec.steps_of(name):
            records[step] = record | {"photo": step.photo}
            for slice_ in (data.slice(each, step.photo) for each in stage.slices):
                records[step] |= {f"facts:{DATASET}{field}": value for field, value in slice_.fields.items()}
                records[step] |= {f"file:{each}": _hash(data.folder, each, hashes) for each in slice_.files}
            if step.recipe is not None:
                recipe = recipes[step.recipe]
                records[step] |= {"recipe": step.recipe} | {f"recipe:{f}": value for f, value in recipe.facts.items()}
                files = recipe.files.items()
                records[step] |= {f"recipe file:{each}": _hash(path.parent, path.name, hashes) for each, path in files}
    return records


def _given(project: Project, folder: Path, file: str, key: str, cure: str, hashes: FileHashes) -> str:
    try:
        if os.path.lexists(folder / file):
            check_plain(folder / file, "a result", key, most_bytes=None)  # a pipe or a device would never end
        return hashes.content(folder / file)
    except (OSError, TypeError):
        words = "there is no such folder" if not os.path.isdir(folder) else f"it has no readable {file!r}"
        raise InputError(words, file=project.shown(folder), key=key, cure=cure) from None


def _hash(folder: Path, file: str, hashes: FileHashes) -> str:
    try:
        return hashes.content(folder / file)
    except OSError as error:
        words = f"the file {file!r} cannot be read ({error.strerror})"
        raise InputError(words, file=folder, cure="check its name and permissions") from error
