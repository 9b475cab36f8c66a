"""Record of each step: everything that its key is the hash of, but for the results of other steps."""

from pathlib import Path
from typing import Any, NamedTuple

from factorlib.reading import check_plain, reading
from factorlib.runner.closure import Sources
from factorlib.runner.plan import Record, Spec, Step
from factorlib.runner.project import DATASET, LIBRARY, Data, Project, Recipe
from factorlib.runner.store import FileHashes


class StepInputs(NamedTuple):
    """Facts of the dataset or recipe for a step, and files by their names in the record."""

    facts: dict[str, Any]
    files: dict[str, Path]


def step_records(
    project: Project, spec: Spec, data: Data, hashes: FileHashes, recipes: dict[str, Recipe]
) -> tuple[dict[Step, Record], dict[Step, StepInputs]]:
    """Return every step's record without the results of other steps, and its inputs; files count by their content."""
    sources = Sources([project.root, LIBRARY], hashes)
    records: dict[Step, Record] = {}
    inputs: dict[Step, StepInputs] = {}
    for name in spec.pipeline.needed(spec.targets):
        stage = spec.pipeline.stages[name]
        common = {"stage": name, "threads": stage.threads, "makes": stage.makes}
        common |= sources.closure(project.package, name, project.pipeline_file).record
        common |= {f"param:{param}": value for param, value in stage.values.items()}
        for step in spec.steps_of(name):
            record: Record = common | {"photo": step.photo}
            facts: dict[str, Any] = {}
            if step.photo is None:
                gathered = {f"gathered:{each}": spec.pipeline.stages[each].gather for each in stage.upstream}
                record |= {field: file for field, file in gathered.items() if file}
            files = {f"given:{p}/{file}": path / file for p, path in stage.folders.items() for file in stage.given[p]}
            for each in stage.slices:
                slice_ = data.slice(each, step.photo)
                facts[DATASET + each] = slice_.facts
                record |= {f"facts:{DATASET}{field}": value for field, value in slice_.fields.items()}
                files |= {f"file:{file}": data.folder / file for file in slice_.files}
            if step.recipe is not None:
                recipe = recipes[step.recipe]
                facts["recipe"] = recipe.facts
                record |= {"recipe": step.recipe} | {f"recipe:{k}": value for k, value in recipe.facts.items()}
                files |= {f"recipe file:{file}": path for file, path in recipe.files.items()}
            records[step] = record | {field: _file_hash(field, path, name, hashes) for field, path in files.items()}
            inputs[step] = StepInputs(facts, files)
    return records, inputs


def _file_hash(field: str, path: Path, stage: str, hashes: FileHashes) -> str:
    key = f"{stage}.{field.removeprefix('given:').partition('/')[0]}" if field.startswith("given:") else None
    check_plain(path, "a file", key, most_bytes=None)  # a pipe never ends
    with reading("a file", path, key):
        return hashes.content(path)
