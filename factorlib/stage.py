"""Interface of a stage: its inputs by logical name, an output folder, and a progress report.

A stage is a module `stages/<name>.py` with a frozen `Params` struct and `main(params, inputs, out, progress)`.  It does
not know where the store is or whether it runs in a pool.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec


@runtime_checkable
class Progress(Protocol):
    """Callback that reports progress, as often as a stage likes."""

    def __call__(self, done: float, total: float, text: str = "") -> None:
        """Report that `done` of `total` pieces of work are done; `text` describes the current one."""
        ...


def silent(done: float, total: float, text: str = "") -> None:
    """Ignore the progress of a stage that a notebook or a test calls."""


def part_of(progress: Progress, begin: float, end: float) -> Progress:
    """Return a callback that reports its progress as that between two shares of the whole."""

    def report(done: float, total: float, text: str = "") -> None:
        """Report a part's progress."""
        progress(begin + (end - begin) * done / max(total, 1e-9), 1, text)

    return report


def serial_map(function: Callable, items: Iterable) -> list:
    """Apply a function to the items in this process and return all results in order."""
    return [function(item) for item in items]


class Inputs(msgspec.Struct, frozen=True):
    """The declared inputs of one step.

    Attributes:
        folders: folder of files by stage (of this photo only, if both stages are per photo), or by a parameter that
            names one
        facts: JSON-able facts of the dataset by "dataset.<slice>"
        files: absolute path by dataset-relative path as in dataset.yaml
        photo: name of this step's photo, None in a stage over the whole set
        map: an ordered map over independent work
        log: the run log (JSON lines), only for a stage that declares `logs: true`
        unfinished: a folder that survives a kill of this step and is deleted after its success; None outside the runner
    """

    folders: dict[str, Path]
    facts: dict[str, Any] = {}
    files: dict[str, Path] = {}
    photo: str | None = None
    map: Callable = serial_map
    log: Path | None = None
    unfinished: Path | None = None

    def __getitem__(self, stage: str) -> Path:
        return self.folders[stage]

    def file(self, relative: str) -> Path:
        """Return the absolute path of a file of dataset.yaml; KeyError for one that the step did not declare."""
        return self.files[relative]

    def mesh(self, name: str, file: str | None) -> Path:
        """Return the absolute path of a mesh: its file in dataset.yaml, or the result of the stage `shapes`."""
        return self.file(file) if file else self.folders["shapes"] / "meshes" / f"{name}.obj"
