"""Looking at files before anything runs: a fault in the last photo, or in a recipe, is reported before the first is worked on.

What there is to look at, and how, the dataset's provider knows; here is which files a run has not used yet.
"""

from __future__ import annotations

from collections.abc import Iterable

from factorlib.errors import InputError
from factorlib.runner.pipeline import DATASET
from factorlib.runner.plan import Planned, Record, Step
from factorlib.runner.survey import Survey
from factorlib.runner.worker import Code, value_fault


def new_faults(seen: Survey, planned: list[Planned]) -> list[InputError]:
    """Of the files that steps are to read which have no result of them yet, each fault once; files of the dataset and of recipes
    that have all been used cost nothing."""
    return faults(seen, [p.step for p in planned if p.status != "current" and _is_new(seen, p.step)])


def wrong_values(seen: Survey, planned: list[Planned]) -> list[InputError]:
    """Of the parameters that steps would run with: one out of its range, or of another kind.

    Only a stage that is given any is imported, which takes seconds where it computes.
    """
    found, project, stages = [], seen.project, seen.spec.pipeline.stages
    for name in dict.fromkeys(p.step.stage for p in planned if p.status != "current" and stages[p.step.stage].values):
        code = Code(project.root, project.package, name, stages[name].values, project.pipeline_file, words=seen.words)
        if fault := value_fault(code):
            found.append(fault)
    return found


def faults(seen: Survey, steps: Iterable[Step]) -> list[InputError]:
    """Of all files that the steps read, those of their recipes too; where several stages take a slice, by the parameters of the first."""
    found, done = {}, set()
    for step in steps:
        if step.recipe is not None:
            found |= {str(fault): fault for fault in seen.data.recipe_faults(seen.recipes[step.recipe].files)}
        stage = seen.spec.pipeline.stages[step.stage]
        for slice_ in stage.slices:
            if (slice_, step.photo) not in done:
                done.add((slice_, step.photo))
                for fault in seen.data.faults(slice_, step.photo, stage.values, seen.project.pipeline_file):
                    found.setdefault(str(fault), fault)
    return list(found.values())


def _is_new(seen: Survey, step: Step) -> bool:
    """Whether the step's part of the dataset, or a file of its recipe, is another than that of its last result."""
    before = seen.previous.get(str(step))
    return before is None or _of_files(before) != _of_files(seen.records[step])


def _of_files(record: Record) -> Record:
    return {name: value for name, value in record.items() if name.startswith(("file:", "recipe file:", f"facts:{DATASET}"))}
