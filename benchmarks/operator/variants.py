"""The operators as they can be run: every one that `reflection_operator` knows, in every precision, compiled or in torch."""

from __future__ import annotations

import os
from contextlib import contextmanager

import torch

from factorlib.errors import InputError
from factorlib.reflection import Operator, reflection_operator
from factorlib.reflection.operator import NAMES

REFERENCE = "reference"


def fast_names() -> list[str]:
    """Names of all operators but the reference."""
    return [name for name in NAMES if name != REFERENCE]


def made(name: str, dtype: str, *, compiled: bool = True) -> Operator | None:
    """The operator in this precision; None if there is no such one (its InputError), or nothing of it is compiled to leave out."""
    with without_compiler() if not compiled else unchanged():
        try:
            operator = reflection_operator(name, dtype=dtype)
        except InputError:
            return None
    return operator if compiled or hasattr(operator, "fused") else None


def variants(dtypes: tuple[str, ...] = ("float32", "float64")) -> dict[str, Operator]:
    """Fast operators by label, e.g. "network float32"; "network float32 torch" is its torch path where C is there too."""
    found: dict[str, Operator | None] = {}
    for name in fast_names():
        for dtype in dtypes:
            found[f"{name} {dtype}"] = made(name, dtype)
        if any(getattr(found[f"{name} {dtypes[0]}"], "fused", {}).values()):
            found[f"{name} {dtypes[0]} torch"] = made(name, dtypes[0], compiled=False)
    return {label: operator for label, operator in found.items() if operator is not None}


def of_dtype(name: str, dtype: torch.dtype) -> Operator | None:
    """The operator in a precision that `reflection_operator` does not offer: weights and inputs rounded to it."""
    operator = made(name, "float64")
    if operator is None:
        return None
    operator.dtype = dtype
    if hasattr(operator, "layers"):
        operator.layers = {part: layers.to(dtype) for part, layers in operator.layers.items()}
    return operator


@contextmanager
def without_compiler():
    before = os.environ.get("FACTORLIB_FUSED")
    os.environ["FACTORLIB_FUSED"] = "0"
    try:
        yield
    finally:
        os.environ.pop("FACTORLIB_FUSED")
        if before is not None:
            os.environ["FACTORLIB_FUSED"] = before


@contextmanager
def unchanged():
    yield
