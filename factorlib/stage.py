"""What a stage sees of the world: its inputs by logical name, an output folder, a way to say how far it is.

A stage is a module `stages/<name>.py` with a frozen `Params` struct and `main(params, inputs, out, progress)`.
It never learns where the store lies or whether it runs in a pool.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec


@runtime_checkable
class Progress(Protocol):
    """Called as often as a stage likes: `done` of `total` pieces of work, and what is being done."""

    def __call__(self, done: float, total: float, text: str = "") -> None: ...


def silent(done: float, total: float, text: str = "") -> None:
    """The progress of a stage that is called from a notebook or a test."""


def serial_map(function: Callable, items: Iterable) -> list:
    """`map` in this process, all results at once, in the order of `items`."""
    return [function(item) for item in items]


class Inputs(msgspec.Struct, frozen=True):
    """The declared inputs of one step.

    folders: stage name -> folder of that stage's files (of this photo only, where both are per photo);
             parameter that names a folder -> that folder, where it is given
    facts:   "dataset.<slice>" -> JSON-able facts of the dataset
    files:   dataset-relative path, as it stands in dataset.yaml -> absolute path
    photo:   name of this step's photo, None in a stage over the whole set
    map:     an ordered map over independent work
    log:     the run log (JSON lines), only for a stage that declares `logs: true`
    unfinished: a folder that outlives a kill of this step and goes with its success; None outside the runner
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
        """Absolute path of a file that dataset.yaml names; KeyError for one that this step did not declare."""
        return self.files[relative]

    def mesh(self, name: str, file: str | None) -> Path:
        """Absolute path of a mesh: of its file in dataset.yaml, or where it has none, of what the stage `shapes` found."""
        return self.file(file) if file else self.folders["shapes"] / "meshes" / f"{name}.obj"
