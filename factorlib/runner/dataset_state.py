"""State of a dataset before a run: each step's record, from the sources, the dataset and the installed packages."""

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from factorlib.errors import InputError, fault_lines
from factorlib.jsonfile import json_text
from factorlib.runner.plan import Listing, PlannedStep, Record, Spec, Step, plan
from factorlib.runner.project import (
    ALL,
    MOST_CORES,
    Data,
    Pipeline,
    Project,
    Recipe,
    StageCode,
    blame_setting,
    read_pipeline,
    with_settings,
)
from factorlib.runner.results_folder import ResultsFolder, make_view, results_of, set_link
from factorlib.runner.step_records import StepInputs, step_records
from factorlib.runner.store import Store
from factorlib.wholefile import replace_file

RENDER = "render"  # the stage whose pictures a recipe replaces


class Request(NamedTuple):
    """Request of the command line.

    targets:  stages; None for all that are not optional
    settings: `stage.parameter=value`;  force: run the targets again, whatever the store holds
    recipes:  paths, names or `all`: stages over recipes make their pictures
    held_out: names of photos to hold out, beside those that the dataset holds out
    """

    dataset: str
    targets: list[str] | None = None
    settings: Sequence[str] = ()
    force: bool = False
    recipes: Sequence[str] = ()
    held_out: Sequence[str] = ()


@dataclass
class DatasetState:
    """State of a dataset before a run; every verb shows or runs its plan.

    project:  the checkout
    data:     the dataset
    results:  its results folder
    store:    store of all results
    spec:     requested stages, photos, recipes and forced steps
    records:  each step's record without the results of other steps
    inputs:   facts and files of each step
    recipes:  requested recipes, by name
    previous: each step's record when it last was current for this dataset
    settings: settings of the command line, which replace values of pipeline.yaml
    """

    project: Project
    data: Data
    results: ResultsFolder
    store: Store
    spec: Spec
    records: dict[Step, Record]
    inputs: dict[Step, StepInputs]
    previous: dict[str, Record]
    recipes: dict[str, Recipe]
    settings: Sequence[str]

    def plan(self, forced: frozenset[Step] | None = None) -> list[PlannedStep]:
        """Plan every step; `forced`, if given, replaces the steps that must run in any case."""
        spec = self.spec if forced is None else msgspec.structs.replace(self.spec, forced=forced)
        return plan(spec, self.records, Listing(self.store, self.previous, self.store.damaged))

    def code(self, name: str) -> StageCode:
        """Return the description of a stage with which a worker loads it."""
        stage = self.spec.pipeline.stages[name]
        cores = MOST_CORES if stage.cores == "all" else stage.cores
        place = self.project.root, self.project.package, name
        return StageCode(*place, stage.values, self.project.pipeline_file, stage.threads, cores)

    def file_faults(self, steps: Iterable[Step]) -> list[str]:
        """List the faults of the files that steps and their recipes read, each once, one of many files once for all."""
        faults: list[InputError] = []
        requests = []
        for step in steps:
            stage = self.spec.pipeline.stages[step.stage]
            faults += self.data.recipe_faults(self.recipes[step.recipe].files) if step.recipe is not None else []
            requests += [(slice_, step.photo, stage.values, self.project.pipeline_file) for slice_ in stage.slices]
        faults += self.data.faults(requests) if requests else []
        return fault_lines(faults)

    def parameter_faults(self, planned: list[PlannedStep]) -> list[str]:
        """List the faults of the parameters of steps that are not current.

        Only stages with parameters are imported, each in a process, because that takes seconds.
        """
        pending = dict.fromkeys(p.step.stage for p in planned if p.status != "current")
        stages = self.spec.pipeline.stages
        codes = [self.code(name) for name in pending if stages[name].values and not stages[name].params_of]
        if not codes:
            return []
        from factorlib.runner.worker import Workers, check_params  # A run with nothing to do does not load it.

        with contextlib.closing(Workers()) as workers:
            futures = [workers.submit(1, code.threads, check_params, code) for code in codes]
            errors = [future.exception() for future in futures]
        # A module that cannot be loaded reports that when it runs.
        return [str(blame_setting(error, self.settings)) for error in errors if isinstance(error, InputError)]

    def publish(self, planned: list[PlannedStep]) -> None:
        """Make the links in the results folder, and current.json, name the current results."""
        stages = self.spec.pipeline.stages
        current = {p.step: p for p in planned if p.status == "current"}
        keys = {str(step): p.key for step, p in current.items()}
        links = {str(step): self.store.trees / p.output for step, p in current.items() if not step.photo}
        for name in (name for name, stage in stages.items() if stage.over == "photo"):
            if outputs := {step.photo: p.output for step, p in current.items() if step.photo and step.stage == name}:
                links[name] = make_view(self.store, outputs, stages[name].gather)
        for name, folder in links.items():
            set_link(self.results.folder / name, folder, self.project.build)
        for link in self.results.folder.glob("[!.]*"):  # Hidden ones are drafts of links, perhaps of another run.
            if link.is_symlink() and link.name not in stages:
                link.unlink(missing_ok=True)
        # Results that this request did not ask for stay; those of former photos and stages are dropped.
        names = {*stages, *(str(step) for stage in stages for step in self.spec.steps_of(stage))}
        over_recipes = tuple(f"{name}/" for name, stage in stages.items() if stage.over == "recipe")
        before = self.results.keys()
        keys = {name: key for name, key in before.items() if name in names or name.startswith(over_recipes)} | keys
        self.results.set_owner(self.project, self.data.folder)
        if keys != before:
            replace_file(self.results.keys_file, json_text(keys).encode())
        self.store.hashes.save()


def read_state(project: Project, request: Request, look: bool = False) -> DatasetState:
    """Read pipeline, settings, dataset, recipes and store, from which a plan is made.

    Args:
        project: the project
        request: recipes in it add the stages over recipes; with the target `render` these are the only targets.  Such a
            stage among the targets, without recipes, stands for all recipes
        look: True if nothing will run; recipes without targets then request the stages over recipes alone

    Raises:
        InputError: Pipeline, settings, dataset or recipes are wrong.
    """
    try:
        pipeline = with_settings(read_pipeline(project.pipeline_file, project.provider.slices), request.settings)
        targets, recipe_words = _targets(pipeline, request, look)
        pipeline.check(targets or [])
        data = project.provider.read(project.dataset_folder(request.dataset), request.held_out)
        present = pipeline.for_data(lambda name: data.slice(name, None).facts is None)
        for name in (name for name in targets or [] if name not in present.stages):
            when = pipeline.stages[name].when
            fault = f"the stage {name!r} does not apply: the dataset has nothing for it ({when})"
            raise InputError(fault, file=data.folder, cure="leave the stage out")
        results = results_of(project, data.folder)
        store = Store(project.store)
        recipes = project.recipes(data, recipe_words)
        spec = Spec(present, data.photos, targets, recipes=list(recipes))
        if request.force:
            forced = frozenset(step for name in targets or present.stages for step in spec.steps_of(name))
            spec = msgspec.structs.replace(spec, forced=forced)
        records, inputs = step_records(project, spec, data, store.hashes, recipes)
    except InputError as error:
        raise blame_setting(error, request.settings) from None
    store.hashes.save()
    entries = {step: store.entry(key) for step, key in results.keys().items()}
    previous = {step: entry.record for step, entry in entries.items() if entry}
    return DatasetState(project, data, results, store, spec, records, inputs, previous, recipes, request.settings)


def _targets(pipeline: Pipeline, request: Request, look: bool) -> tuple[list[str] | None, Sequence[str]]:
    """Return the requested stages, None for the usual ones, and the requested recipes."""
    targets = request.targets
    over_recipes = [name for name, stage in pipeline.stages.items() if stage.over == "recipe"]
    if not request.recipes:
        return targets, [ALL] if set(over_recipes) & set(targets or []) else []
    if targets == [RENDER] or (look and targets is None):
        return over_recipes, request.recipes
    usual = [name for name, stage in pipeline.stages.items() if not stage.optional]
    return list(dict.fromkeys([*(usual if targets is None else targets), *over_recipes])), request.recipes
