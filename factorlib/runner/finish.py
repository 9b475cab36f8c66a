"""After a run, or where there was nothing to run: build/<dataset>/<stage> names the current result of each stage."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

from factorlib.runner.home import claim
from factorlib.runner.leftover import sweep_drafts
from factorlib.runner.plan import Planned, Step
from factorlib.runner.survey import Survey
from factorlib.runner.views import point, view_of

LONGEST = 85  # bytes of the name of a step's files, to which suffixes are added


def remember(survey: Survey, more: dict[str, str] | None = None, planned: list[Planned] | None = None) -> None:
    """Write down which key each step has now; steps of photos and stages that are no more are dropped.

    more: keys of steps that were just made, in the midst of a run;  planned: a plan that nothing has changed since
    """
    planned = [] if more is not None else survey.planned(frozenset()) if planned is None else planned
    pipeline, spec = survey.spec.pipeline, survey.spec
    there = {str(step) for stage in pipeline.stages for step in spec.steps_of(stage)}
    over_recipes = tuple(f"{name}/" for name, stage in pipeline.stages.items() if stage.over == "recipe")  # kept: others were asked for before
    before = survey.home.last_keys()
    keys = {step: key for step, key in before.items() if step in there or step.startswith(over_recipes)} | (more or {})
    keys |= {str(p.step): p.key for p in planned if p.status == "current"}
    if keys != before:
        claim(survey.project, survey.home, survey.data.folder)
        survey.home.write_keys(keys)
    if more is None:
        show(survey, planned)
        survey.outputs.inspector.save()


def show(survey: Survey, planned: list[Planned]) -> None:
    """Point the links at the current results; of a stage over photos, at one folder with all of them; one for each recipe."""
    for p in planned:
        if p.step.recipe and p.status == "current":
            point(survey.home.pictures(p.step.stage) / p.step.recipe, survey.store.tree(p.output))
    for stage in dict.fromkeys(p.step.stage for p in planned if not p.step.recipe):
        current = {p.step.photo: p.output for p in planned if p.step.stage == stage and p.status == "current"}
        if current:
            point(survey.home.folder / stage, folder_of(survey, stage, current))
    for link in survey.home.folder.glob("[!.]*"):  # hidden ones are drafts of links, of another run perhaps
        if link.is_symlink() and link.name not in survey.spec.pipeline.stages:
            link.unlink(missing_ok=True)
    _drop_errors(survey, planned)
    sweep_drafts(survey.home.folder)


def _drop_errors(survey: Survey, planned: list[Planned]) -> None:
    """What is written of a step's failure goes once it has succeeded, or is no more."""
    there = {label(step) for stage in survey.spec.pipeline.stages for step in survey.spec.steps_of(stage)}
    good = {label(p.step) for p in planned if p.status == "current"}
    folder = survey.home.folder / "errors"
    for path in folder.glob("*.txt"):
        if path.stem in good or path.stem not in there:
            path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # what is not empty stays; another run may have removed the folder
        folder.rmdir()


def label(step: Step) -> str:
    """The name of a step's own files, short however long the photo's name is.

    >>> label(Step("masks", "kitchen")), len(label(Step("masks", "k" * 240)))
    ('masks-kitchen', 70)
    """
    name = str(step).replace("/", "-")
    return name if len(name.encode()) <= LONGEST else f"{step.stage[:20]}-{hashlib.sha256(name.encode()).hexdigest()}"


def folder_of(survey: Survey, stage: str, outputs: dict[str | None, str]) -> Path:
    """Where a stage's result lies: its tree in the store, or for a stage over photos a view of all photos' trees.

    outputs: tree hash by photo; by None for a stage over the whole set
    """
    spec = survey.spec.pipeline.stages[stage]
    return view_of(survey.store, survey.outputs.inspector, outputs, spec.gather) if spec.over else survey.store.tree(outputs[None])


def results(survey: Survey) -> list[tuple[str, Path]]:
    """What a user looks at first, as far as it is there."""
    folder = survey.home.folder
    found = [
        ("report", folder / "report" / "index.html"),
        ("materials", folder / "export" / "materials.json"),
        ("environment maps", folder / "export" / "illumination"),
        ("re-syntheses", folder / "render" / "resynthesis"),
    ]
    return [(label, path) for label, path in found if path.exists()]
