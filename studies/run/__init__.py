"""Study as the project's runner sees it: a data set whose photos are the study's cases.

Nothing is declared anew: steps, keys, the store, locks, resuming, progress and the pool of processes are the runner's
(`factorlib.runner`).  Results of studies have a store of their own in build/studies, those of quick ones in
build/studies/quick, so that no reader takes one for the other.  To delete them all, delete that folder.  The conclusion
from the cases is not a step: it takes a second and is written anew after each run (`studies.run.tables`).
"""

from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Data, Project, Provider
from studies.catalogue import STUDIES
from studies.study import FULL, Scale

SLICES = ("case", "worlds", "sets")


class Slice(msgspec.Struct, frozen=True):
    """Facts that a step sees of the study."""

    facts: Any
    fields: dict[str, Any]
    files: list[str] = []


class Studies(Project, frozen=True):
    """The checkout, with studies of a scale in place of data sets."""

    scale: Scale = FULL

    @property
    def pipeline_file(self) -> Path:
        """The file that declares the steps of all studies."""
        return Path(__file__).with_name("pipeline.yaml")

    @property
    def build(self) -> Path:
        """The folder of all results of this scale."""
        folder = self.root / "build" / "studies"
        return folder / "quick" if self.scale.quick else folder

    def dataset_folder(self, name: str) -> Path:
        """Return the path that identifies a study, where no folder exists.  InputError for an unknown study."""
        if name not in STUDIES:
            raise InputError(f"there is no study {name!r}", key="STUDY", cure=did_you_mean(name, STUDIES))
        return self.root / "studies" / name

    find_dataset = dataset_folder


def studies(scale: Scale = FULL, root: Path = LIBRARY) -> Studies:
    """Return the project of the studies of a scale."""
    return Studies(root, Provider(SLICES, lambda folder, _: data_of(folder, scale)), "studies.steps", scale=scale)


def data_of(folder: Path, scale: Scale) -> Data:
    """Return a study as the runner reads it."""
    study = STUDIES[folder.name]
    cases = study.cases(scale)

    def slice_(name: str, case: str | None) -> Slice:
        """Return the facts of a slice; its fields are what a change is reported by."""
        facts = {"worlds": study.worlds, "sets": study.sets, "case": lambda _: cases[case]}
        plain = msgspec.to_builtins(facts[name](scale))
        return Slice(plain, {f"{name}.{field}": value for field, value in plain.items()})

    return Data(folder, list(cases), slice_)


def make(
    scale: Scale, names: list[str], force: bool = False, settings: list[str] | None = None, root: Path = LIBRARY
) -> int:
    """Run the steps of studies that are not current.

    Their results lie in build/studies afterwards.

    settings: where their steps run, as `executor=tcp://…`

    A failed study does not stop the others.  Returns the exit code of the first failed study; 0 if none failed.
    """
    codes = []
    for name in names:
        project = studies(scale, root)
        study = STUDIES[name]
        if scale.quick:
            print(f"{name}: quick: one seed, smallest sets: no conclusion")
        request = verbs.Request(name, targets=list(study.steps), settings=settings or [], force=force)
        codes.append(verbs.make(project, request))
        if codes[-1] == 0:
            from studies.run.tables import write_study  # here: a plan must not pay for science

            folder = project.build / name
            write_study(study, scale, folder / study.steps[-1] / "scores.json", folder)
            print(f"  study: {project.short_path(folder / 'paragraph.md')}")
    return next((code for code in codes if code), 0)
