"""What a plan is made from: each step's own record, from the sources, the dataset and the installed packages."""

from __future__ import annotations

import contextlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain
from factorlib.runner.closure import Closure, Sources
from factorlib.runner.defaults import other_than
from factorlib.runner.filehash import FileHashes
from factorlib.runner.home import Home, home_of
from factorlib.runner.packages import Packages
from factorlib.runner.pipeline import (
    DATASET,
    Pipeline,
    Stage,
    check_values,
    read_pipeline,
    said_of_settings,
    with_settings,
    words_by_key,
)
from factorlib.runner.plan import Listing, Planned, Record, Spec, Step, plan
from factorlib.runner.project import Data, Project, Recipe
from factorlib.runner.store import Outputs, Store


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
    outputs: Outputs
    previous: dict[str, Record]
    recipes: dict[str, Recipe]
    words: dict[str, str]

    def planned(self, forced: frozenset[Step] | None = None) -> list[Planned]:
        """Every step with its state and the reason for it; `forced` replaces the spec's steps that must run."""
        spec = self.spec if forced is None else msgspec.structs.replace(self.spec, forced=forced)
        return plan(spec, self.records, Listing(self.outputs, self.previous, self.outputs.damaged))


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
    words, pipeline = (
        words_by_key(settings),
        with_settings(read_pipeline(project.pipeline_file, project.provider.slices), settings),
    )
    try:
        check_values(pipeline, project.pipeline_file)
    except InputError as error:
        raise said_of_settings(error, words) from None
    for name in targets or []:
        if name not in pipeline.stages:
            raise InputError(
                f"there is no stage {name!r}", file=project.pipeline_file, cure=did_you_mean(name, pipeline.stages)
            )
    folder = project.dataset_folder(dataset)
    data = project.provider.read(folder)
    home, store = home_of(project, data.folder), Store(project.build / "store")
    asked = project.recipes(data, recipes or [])
    spec = Spec(pipeline, data.photos, targets, recipes=list(asked))
    if force:
        forced = pipeline.stages if targets is None else targets
        spec = msgspec.structs.replace(spec, forced=frozenset(step for name in forced for step in spec.steps_of(name)))
    hashes, packages = FileHashes(store.cache / "files.json"), Packages(store.cache / "packages.json")
    try:
        records = _records(project, spec, data, hashes, packages, asked)
    except InputError as error:
        raise said_of_settings(error, words) from None
    with contextlib.suppress(OSError):  # of a build/ that is read-only: the next command reads more, that is all
        hashes.save()
        packages.save()
    outputs = Outputs(store)
    entries = {step: outputs.entry(key) for step, key in home.last_keys(warn=True).items()}
    return Survey(
        project,
        data,
        home,
        store,
        spec,
        records,
        outputs,
        {step: e.record for step, e in entries.items() if e},
        asked,
        words,
    )


def _records(
    project: Project, spec: Spec, data: Data, hashes: FileHashes, packages: Packages, recipes: dict[str, Recipe]
) -> dict[Step, Record]:
    sources = Sources(project.source_roots, hashes)
    _check_params(project, spec.pipeline, sources)
    records = {}
    for name in spec.pipeline.needed(spec.targets):
        of_stage = _stage_record(
            name, spec.pipeline, sources.closure(project.package, name, project.pipeline_file), packages
        )
        values = other_than(sources.default_values(project.package, name), spec.pipeline.stages[name].values)
        of_stage |= {f"param:{param}": value for param, value in values.items()}
        of_stage |= {
            f"default:{param}": text
            for param, text in sources.stage_params(project.package, name, project.pipeline_file).items()
        }
        of_stage |= _given(name, spec.pipeline, project, hashes)
        for step in spec.steps_of(name):
            records[step] = of_stage | {"photo": step.photo} | _slices(step, spec.pipeline, data, hashes)
            if step.recipe is not None:
                records[step] |= {"recipe": step.recipe} | _recipe(recipes[step.recipe], hashes)
    return records


def _recipe(recipe: Recipe, hashes: FileHashes) -> Record:
    """What a recipe says, and the files it names, by content."""
    files = {f"recipe file:{name}": _content(path, hashes) for name, path in recipe.files.items()}
    return {f"recipe:{field}": value for field, value in recipe.facts.items()} | files


def _check_params(project: Project, pipeline: Pipeline, sources: Sources) -> None:
    """Names of parameters, without importing a stage; their values are checked when it is loaded."""
    for name, stage in pipeline.stages.items():
        if not stage.params:
            continue
        known = [*sources.stage_params(project.package, name, project.pipeline_file), *stage.given]
        for param in stage.params:
            if param not in known:
                where = f"stages.{name}.params.{param}"
                cure = did_you_mean(param, known) if known else "leave it out"
                raise InputError(
                    f"the stage {name!r} has no parameter {param!r}", file=project.pipeline_file, key=where, cure=cure
                )


def _stage_record(name: str, pipeline: Pipeline, closure: Closure, packages: Packages) -> Record:
    stage = pipeline.stages[name]
    record = {
        "stage": name,
        "threads": stage.threads,
        "python": f"{sys.version_info[0]}.{sys.version_info[1]}",
        "makes": stage.makes,
    }
    return (
        record
        | closure.record()
        | {f"package:{package}": version for package, version in packages.versions(closure.external).items()}
    )


def _given(name: str, pipeline: Pipeline, project: Project, hashes: FileHashes) -> Record:
    """The files of the folders that parameters name, by content."""
    stage, record = pipeline.stages[name], {}
    for param, files in ((param, stage.given[param]) for param in stage.folders):
        folder = given_folder(stage, param)
        for file in files:
            try:
                if os.path.lexists(folder / file):
                    check_plain(
                        folder / file, "a result", f"{name}.{param}", most_bytes=None
                    )  # a pipe or a device would never end
                record[f"given:{param}/{file}"] = hashes.content(folder / file)
            except (OSError, TypeError):
                found = "there is no such folder" if not os.path.isdir(folder) else f"it has no readable {file!r}"
                key, cure = (
                    f"{name}.{param}",
                    f"name a folder with {', '.join(files)}, such as the result of an earlier run of the stage",
                )
                raise InputError(found, file=project.shown(folder), key=key, cure=cure) from None
    return record


def given_folder(stage: Stage, param: str) -> Path:
    """The folder that a parameter names, from where the user stands; links are followed now, for results move on."""
    named = str(stage.folders[param])
    try:
        return Path(named).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # links in a circle, a part too long, a NUL
        found = f"{named[:100]!r} is no path ({getattr(error, 'strerror', None) or error})"
        raise InputError(found, key=param, cure="name a folder") from error


def _slices(step: Step, pipeline: Pipeline, data: Data, hashes: FileHashes) -> Record:
    """The slices of the dataset that a step declares, field by field, and the files they name, by content."""
    record: Record = {}
    for name in pipeline.stages[step.stage].slices:
        slice_ = data.slice(name, step.photo)
        record |= {f"facts:{DATASET}{field}": value for field, value in slice_.fields.items()}
        for file in slice_.files:
            record[f"file:{file}"] = _hash(data.folder, file, hashes)
    return record


def _content(path: Path, hashes: FileHashes) -> str:
    return _hash(path.parent, path.name, hashes)


def _hash(folder: Path, file: str, hashes: FileHashes) -> str:
    try:
        return hashes.content(folder / file)
    except OSError as error:
        raise InputError(
            f"the file {file!r} cannot be read ({error.strerror})", file=folder, cure="check its name and permissions"
        ) from error
