"""What a plan is made from: each step's own record, from the sources, the dataset and the installed packages."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text
from factorlib.reading import check_plain, reading
from factorlib.runner.closure import Sources
from factorlib.runner.plan import Listing, Planned, Record, Spec, Step, plan
from factorlib.runner.project import (
    ALL,
    DATASET,
    LIBRARY,
    MOST_CORES,
    Code,
    Data,
    Project,
    Recipe,
    read_pipeline,
    said_of_settings,
    with_settings,
)
from factorlib.runner.results_folder import Home, claim, home_of, label, point, view_of
from factorlib.runner.store import FileHashes, Store
from factorlib.wholefile import replace_file

RENDER = "render"  # the stage whose pictures a recipe replaces
READ = ("file:", "recipe file:", f"facts:{DATASET}")  # fields of a record: of the dataset and recipe, what a step reads


class Handed(NamedTuple):
    """Facts of the dataset or recipe that a step is handed, and files by the name that its record has for them."""

    facts: dict[str, Any]
    files: dict[str, Path]


@dataclass
class Survey:
    """State of a dataset before anything runs; `planned` is what every verb shows.

    records:  each step's record but for the results it is handed
    handed:   facts and files of each step
    recipes:  those that are asked for, by name
    previous: the record each step had when it last was current for this dataset
    settings: words of the command line in place of values of pipeline.yaml
    """

    project: Project
    data: Data
    home: Home
    store: Store
    spec: Spec
    records: dict[Step, Record]
    handed: dict[Step, Handed]
    previous: dict[str, Record]
    recipes: dict[str, Recipe]
    settings: list[str]

    def planned(self, forced: frozenset[Step] | None = None) -> list[Planned]:
        """Plan every step, with its state and the reason for it; `forced` replaces the spec's steps that must run."""
        spec = self.spec if forced is None else msgspec.structs.replace(self.spec, forced=forced)
        return plan(spec, self.records, Listing(self.store, self.previous, self.store.damaged))

    def code(self, name: str) -> Code:
        """Describe a stage with its parameters, as a worker loads it."""
        stage, project = self.spec.pipeline.stages[name], self.project
        cores = MOST_CORES if stage.cores == "all" else stage.cores
        return Code(project.code_root, project.package, name, stage.values, project.pipeline_file, stage.threads, cores)

    def faults(self, steps: Iterable[Step], new: bool = False) -> list[str]:
        """List the faults of the files that steps read, those of their recipes too, each fault once.

        new: only where the step's part of the dataset, or a file of its recipe, is another than that of its last result
        """
        faults: dict[str, None] = {}
        for step in steps:
            stage, before = self.spec.pipeline.stages[step.stage], self.previous.get(str(step))
            now = {name: value for name, value in self.records[step].items() if name.startswith(READ)}
            if new and before is not None and now == {k: v for k, v in before.items() if k.startswith(READ)}:
                continue
            errors = self.data.recipe_faults(self.recipes[step.recipe].files) if step.recipe is not None else []
            for slice_ in stage.slices:
                errors = [*errors, *self.data.faults(slice_, step.photo, stage.values, self.project.pipeline_file)]
            faults |= dict.fromkeys(map(str, errors))
        return list(faults)

    def wrong_values(self, planned: list[Planned]) -> list[str]:
        """Return the faults of the parameters that steps would run with: one out of its range, or of another kind.

        Only a stage that is given any is imported, in a process of its own: that takes seconds where it computes.
        """
        open_ = dict.fromkeys(p.step.stage for p in planned if p.status != "current")
        codes, faults = [self.code(name) for name in open_ if self.spec.pipeline.stages[name].values], []
        if codes:
            from factorlib.runner.worker import Workers, check_params  # A run with nothing to do does not load it.

            with contextlib.closing(Workers()) as workers:
                for future in [workers.submit(1, code.threads, check_params, code) for code in codes]:
                    error = future.exception()
                    if isinstance(error, InputError):  # A module that cannot be loaded reports that when it runs.
                        faults.append(str(said_of_settings(error, self.settings)))
        return faults

    def remember(self, made: dict[str, str]) -> None:
        """Write down the keys that steps have now; steps of photos and stages that are no more are dropped."""
        stages, before = self.spec.pipeline.stages, self.home.keys(lenient=True)
        names = {*stages, *(str(step) for stage in stages for step in self.spec.steps_of(stage))}
        asked_for_before = tuple(f"{name}/" for name, stage in stages.items() if stage.over == "recipe")
        keys = {name: key for name, key in before.items() if name in names or name.startswith(asked_for_before)} | made
        if keys != before:
            claim(self.project, self.home, self.data.folder)
            replace_file(self.home.keys_file, json_text(keys).encode())

    def show(self, planned: list[Planned]) -> None:
        """Record what is current, and make the links lead there: for a stage over photos, to one folder of them all."""
        home, store, stages = self.home, self.store, self.spec.pipeline.stages
        current = {p.step: p for p in planned if p.status == "current"}
        keys, of_photos = {str(step): p.key for step, p in current.items()}, {}
        for step, p in current.items():
            if step.photo:
                of_photos.setdefault(step.stage, {})[step.photo] = p.key
            else:
                point(home.folder / str(step), store.trees / p.output, self.project.build)
        for name, of in of_photos.items():
            keys[name] = view_of(store, name, of, stages[name].gather)
            point(home.folder / name, store.trees / store.get(keys[name]), self.project.build)
        self.remember(keys)
        for link in home.folder.glob("[!.]*"):  # hidden ones are drafts of links, of another run perhaps
            if link.is_symlink() and link.name not in stages:
                link.unlink(missing_ok=True)
        failed = {label(step) for stage in stages for step in self.spec.steps_of(stage) if step not in current}
        for path in (path for path in home.errors.glob("*.txt") if path.stem not in failed):
            path.unlink(missing_ok=True)  # what is written of a failure goes with success, or with the step
        with contextlib.suppress(OSError):  # what is not empty stays; another run may have removed the folder
            home.errors.rmdir()
        store.save()


def survey(
    project: Project,
    dataset: str,
    targets: list[str] | None,
    settings: list[str],
    force: bool = False,
    recipes: list[str] | None = None,
    look: bool = False,
) -> Survey:
    """Read everything a plan needs.

    Every InputError about pipeline, settings, dataset or recipes is raised here.

    recipes: paths or names of those that are asked for, which adds the stages over them; without any, all if such a
             stage is a target.  With the target `render` they are all that is wanted
    look: without running it: where recipes are named and no stage, of the recipes alone
    """
    file = project.pipeline_file
    pipeline = with_settings(read_pipeline(file, project.provider.slices), settings)
    try:
        over_recipes = [name for name, stage in pipeline.stages.items() if stage.over == "recipe"]
        if recipes and (targets == [RENDER] or (look and targets is None)):
            targets = over_recipes
        elif recipes:
            usual = [name for name, stage in pipeline.stages.items() if not stage.optional]
            targets = list(dict.fromkeys([*(usual if targets is None else targets), *over_recipes]))
        elif set(over_recipes) & set(targets or []):
            recipes = [ALL]
        for name in (name for name in targets or [] if name not in pipeline.stages):
            raise InputError(f"there is no stage {name!r}", file=file, cure=did_you_mean(name, pipeline.stages))
        data = project.provider.read(project.dataset_folder(dataset))
        whole, pipeline = pipeline, pipeline.for_data(lambda name: data.slice(name, None).facts is None)
        for name in (name for name in targets or [] if name not in pipeline.stages):
            found = f"the stage {name!r} has nothing to do for this data set"
            raise InputError(found, file=data.folder, key=whole.stages[name].when, cure="leave it out")
        home, store = home_of(project, data.folder), Store(project.store)
        asked = project.recipes(data, recipes or [])
        spec = Spec(pipeline, data.photos, targets, recipes=list(asked))
        if force:
            forced = frozenset(step for name in targets or pipeline.stages for step in spec.steps_of(name))
            spec = msgspec.structs.replace(spec, forced=forced)
        hashes = FileHashes(store.cache / "files.json")
        records, handed = _records(project, spec, data, hashes, asked)
    except InputError as error:
        raise said_of_settings(error, settings) from None
    with contextlib.suppress(OSError):  # of a build/ that is read-only: the next command reads more, that is all
        hashes.save()
    entries = {step: store.entry(key) for step, key in home.keys(lenient=True).items()}
    previous = {step: entry.record for step, entry in entries.items() if entry}
    return Survey(project, data, home, store, spec, records, handed, previous, asked, settings)


def _records(
    project: Project, spec: Spec, data: Data, hashes: FileHashes, recipes: dict[str, Recipe]
) -> tuple[dict[Step, Record], dict[Step, Handed]]:
    """Return every step's own part of its record, and its inputs; each file among these counts by its content."""
    sources, records, handed = Sources([project.code_root, LIBRARY], hashes), {}, {}
    for name in spec.pipeline.needed(spec.targets):
        stage = spec.pipeline.stages[name]
        record = {"stage": name, "threads": stage.threads, "makes": stage.makes}
        record |= sources.closure(project.package, name, project.pipeline_file).record
        record |= {f"param:{param}": value for param, value in stage.values.items()}
        for step in spec.steps_of(name):
            own, facts = record | {"photo": step.photo}, {}
            if step.photo is None:
                above = {f"gathered:{each}": spec.pipeline.stages[each].gather for each in stage.upstream}
                own |= {field: gather for field, gather in above.items() if gather}
            files = {f"given:{p}/{file}": of / file for p, of in stage.folders.items() for file in stage.given[p]}
            for each in stage.slices:
                slice_ = data.slice(each, step.photo)
                facts[DATASET + each] = slice_.facts
                own |= {f"facts:{DATASET}{field}": value for field, value in slice_.fields.items()}
                files |= {f"file:{file}": data.folder / file for file in slice_.files}
            if step.recipe is not None:
                recipe = recipes[step.recipe]
                facts["recipe"] = recipe.facts
                own |= {"recipe": step.recipe} | {f"recipe:{field}": value for field, value in recipe.facts.items()}
                files |= {f"recipe file:{file}": path for file, path in recipe.files.items()}
            records[step] = own | {field: _hash(field, path, name, hashes) for field, path in files.items()}
            handed[step] = Handed(facts, files)
    return records, handed


def _hash(field: str, path: Path, stage: str, hashes: FileHashes) -> str:
    kind, _, rest = field.partition(":")
    key = f"{stage}.{rest.partition('/')[0]}" if kind == "given" else None
    check_plain(path, "a file", key, most_bytes=None)  # a pipe never ends
    with reading("a file", path, key):
        return hashes.content(path)
