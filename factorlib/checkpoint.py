"""Checkpoints of long computations: numbers and tensors in one file, replaced by one rename.

A resumed computation must end in the same bytes as an uninterrupted one.  A checkpoint therefore holds the whole state:
the unknowns, the optimiser's memory, the random generator's state and the progress.
"""

import io
import logging
import pickle
from pathlib import Path
from typing import Any

import torch

from factorlib.wholefile import replace_file

log = logging.getLogger("factorlib")


class Checkpoint:
    """A checkpoint file.

    Attributes:
        path: the file; None saves nothing (a notebook, a test)
    """

    def __init__(self, path: Path | None):
        self.path = path

    def load(self) -> dict[str, Any] | None:
        """Return the last saved state; None if there is none or it cannot be read."""
        if self.path is None or not self.path.exists():
            return None
        try:
            return torch.load(self.path, weights_only=True)
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
            log.warning("%s cannot be read (%s): the computation starts again", self.path.name, error)
            return None

    def save(self, state: dict[str, Any]) -> None:
        """Save the state: tensors, numbers, strings, and lists and dictionaries of them."""
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            stream = io.BytesIO()
            torch.save(state, stream)
            replace_file(self.path, stream.getvalue())
