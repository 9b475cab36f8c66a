"""The journal of a solve: the parts that are done, so that a solve that was killed goes on and ends in the same bytes.

Every part (the choice of effects, the fit of materials, the splittings, …) is a deterministic function of the part before it, so a part that was saved need not be computed again.  Even without a stop the solve goes on from the saved form: the memory
layout of an array can change the order of a sum, and so the last bits.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeVar, get_args, get_type_hints

import msgspec
import numpy as np
import torch

T = TypeVar("T")


class Keeper(Protocol):
    """Keeps one state of tensors, numbers, strings, lists and dictionaries, as `factorlib.checkpoint.Checkpoint` does."""

    def load(self) -> dict[str, Any] | None:
        """What was saved last, None where nothing was."""

    def save(self, state: dict[str, Any]) -> None:
        """Keep the state instead of what was saved before."""


class Journal:
    """keeper: None keeps nothing beyond this process (a notebook, a test)."""

    def __init__(self, keeper: Keeper | None = None):
        self._keeper = keeper
        self._parts: dict[str, Any] = (keeper.load() if keeper else None) or {}

    def kept(self, part: str, type_: type[T]) -> T | None:
        """What was saved of the part, done or half done; None where it was not begun."""
        return restored(type_, self._parts[part]) if part in self._parts else None

    def keep(self, part: str, value: T) -> T:
        """Save the part; returns `value` as `kept` would."""
        self._parts[part] = plain(value)
        if self._keeper:
            self._keeper.save(self._parts)
        return restored(type(value), self._parts[part])


def plain(value: Any) -> Any:
    """Structs as dictionaries, arrays as tensors of their own."""
    if isinstance(value, msgspec.Struct):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    return [plain(item) for item in value] if isinstance(value, list) else value


def restored(type_: type[T], value: Any) -> T:
    """The inverse of `plain`."""
    if isinstance(value, torch.Tensor):
        return value.numpy().copy()
    if isinstance(value, dict):
        hints = get_type_hints(type_)
        return type_(**{name: restored(hints[name], item) for name, item in value.items()})
    return [restored(*get_args(type_), item) for item in value] if isinstance(value, list) else value
