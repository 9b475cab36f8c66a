"""A study as the runner sees it: a data set whose photos are the study's cases.

Nothing is declared anew: steps, keys, the store, locks, resuming, progress and the pool of processes are the runner's
(`factorlib.runner`).  Results of studies have a store of their own in build/studies, those of quick ones in
build/studies/quick, so that neither `make gc` nor a reader takes one for the other.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.filehash import FileHashes
from factorlib.runner.project import LIBRARY, Data, Project, Provider
from studies.catalogue.contents import STUDIES
from studies.core.left_out.case import FOLDER, LeftOutCase
from studies.core.study import FULL, Scale

PIPELINES = Path(__file__).resolve().parent / "pipelines"
SLICES = ("case", "worlds", "study", "photos")
FINISHED = ("figure.svg", "table.csv", "table.json", "paragraph.md")


class Slice(msgspec.Struct, frozen=True):
    """What a step sees of the study."""

    facts: Any
    fields: dict[str, Any]
    files: list[str] = []


class Studies(Project, frozen=True):
    """The checkout, with the studies of one kind in place of data sets."""

    scale: Scale = FULL

    @property
    def pipeline_file(self) -> Path:
        """The file that declares the steps."""
        return PIPELINES / f"{self.package.rpartition('.')[2]}.yaml"

    @property
    def build(self) -> Path:
        """The folder of all results of this scale."""
        folder = self.root / "build" / "studies"
        return folder / "quick" if self.scale.name == "quick" else folder

    def dataset_folder(self, name: str) -> Path:
        """A folder that stands for a study; nothing lies there.  InputError where no study is called so."""
        if name not in STUDIES:
            raise InputError(f"there is no study {name!r}", key="STUDY", cure=did_you_mean(name, STUDIES))
        return self.root / "studies" / name

    def find_dataset(self, name: str) -> Path | None:
        """The same."""
        return self.dataset_folder(name)


def studies(scale: Scale = FULL, root: Path = LIBRARY, kind: str = "spheres") -> Studies:
    """The project of the studies of a scale whose cases are of a kind."""
    return Studies(root, Provider(SLICES, lambda folder: data_of(folder, scale)), f"studies.steps.{kind}", scale)


def photos_of(case: LeftOutCase) -> dict[str, Any]:
    """The photos of a study of a data set, how they are solved, and what the data set contains, so that a step's key has it."""
    hashes, folder = FileHashes(None), LIBRARY / FOLDER
    files = sorted(
        file for file in folder.rglob("*") if file.is_file() and file.relative_to(folder).parts[0] != "truth"
    )
    content = {str(file.relative_to(folder)): hashes.content(file) for file in files}
    return {"folder": FOLDER, "photos": list(case.photos), "solve": case.solve, "content": content}


def data_of(folder: Path, scale: Scale) -> Data:
    """A study as the runner reads it."""
    study = STUDIES[folder.name]
    cases = study.cases(scale)

    def slice_(name: str, photo: str | None) -> Slice:
        """The facts of a slice; its fields are what a change is reported by."""
        facts = {
            "worlds": lambda: scale.worlds,
            "study": lambda: {"name": study.name, "scale": scale},
            "case": lambda: cases.get(photo),
            "photos": lambda: photos_of(next(iter(cases.values()))),
        }
        plain = msgspec.to_builtins(facts[name]())
        return Slice(plain, {f"{name}.{field}": value for field, value in plain.items()})

    return Data(folder, list(cases), slice_)
