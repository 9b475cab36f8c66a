"""What lets a killed computation go on where it was: numbers and tensors in one file, replaced by one rename.

A computation that goes on must end in the same bytes as one that was never stopped, so its whole state is kept: the
unknowns, the optimiser's memory, the random generator's state and how far it is.
"""

from __future__ import annotations

import io
import logging
import pickle
from pathlib import Path
from typing import Any

import torch

from factorlib.wholefile import replace_file

log = logging.getLogger("factorlib")


class Checkpoint:
    """path: the file; None keeps nothing (a notebook, a test)."""

    def __init__(self, path: Path | None):
        self.path = path

    def load(self) -> dict[str, Any] | None:
        """Return what was saved last; None where nothing was, or what is there cannot be read."""
        if self.path is None or not self.path.exists():
            return None
        try:
            return torch.load(self.path, weights_only=True)
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
            log.warning("%s cannot be read (%s): the computation starts again", self.path.name, error)
            return None

    def save(self, state: dict[str, Any]) -> None:
        """Keep `state`: tensors, numbers, strings, lists and dictionaries of them."""
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            stream = io.BytesIO()
            torch.save(state, stream)
            replace_file(self.path, stream.getvalue())
