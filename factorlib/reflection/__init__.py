"""Radiance R(lobe | material) that a surface of Lambert + GGX reflectance reflects of one light lobe.

Four operators compute R behind one interface (`reflection_operator`): `reference` by quadrature, `closed_form` by
formula, `network` by a learned correction of the formula, and `paper_network` by networks without a formula (the
baseline). `network` is compiled where there is a C compiler.

By symmetry the diffuse part depends on 2 scalars (λ, n·z) and the specular part on 5 (α, λ, n·o, n·z, o·z).

One lobe from straight above, on a white Lambertian surface that faces the viewer:

>>> import torch
>>> from types import SimpleNamespace
>>> R = reflection_operator("closed_form")
>>> up = torch.tensor([[0.0, 0.0, 1.0]])
>>> lobes = SimpleNamespace(axis=up, sharpness=torch.tensor([100.0]), weight=torch.ones(1, 3))
>>> white = SimpleNamespace(diffuse=torch.ones(3), specular=torch.zeros(3), roughness=torch.tensor(0.5))
>>> [round(float(radiance), 3) for radiance in R(lobes, white, normals=up, views=up)[0]]
[0.02, 0.02, 0.02]
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from factorlib.errors import InputError, did_you_mean
from factorlib.reflection.operator import NAMES, Name, Operator, Response

__all__ = ["Operator", "Response", "reflection_operator"]
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def reflection_operator(name: Name, weights: str | Path | None = None, *, dtype: str | None = None) -> Operator:
    """Return the reflection operator `name`, importing only its own module.

    Args:
        name: Operator, one of `NAMES`.
        weights: Folder with diffuse.safetensors and specular.safetensors for `network`; None takes the shipped ones.
        dtype: "float32" or "float64"; None takes the operator's default (float64 for `reference`, else float32).

    Returns:
        The operator.

    Raises:
        InputError: If the name or the dtype is unknown.
    """
    if name not in NAMES:
        raise InputError(f"no reflection operator '{name}'", cure=did_you_mean(name, NAMES))
    if dtype is not None and dtype not in DTYPES:
        raise InputError(f"no dtype '{dtype}'", cure=did_you_mean(dtype, DTYPES))
    options: dict[str, Any] = {"dtype": DTYPES[dtype]} if dtype else {}
    Kind: type[Operator]
    if name == "reference":
        from factorlib.reflection.reference import Reference as Kind
    elif name == "closed_form":
        from factorlib.reflection.closed_form import ClosedForm as Kind
    elif name == "network":
        from factorlib.reflection.network import Network as Kind

        options["weights"] = weights
    else:
        from factorlib.reflection.paper_network import PaperNetwork as Kind
    return Kind(**options)
