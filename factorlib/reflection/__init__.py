"""R(lobe | material): what a surface of Lambert + GGX reflectance reflects of one light lobe.

Four operators compute it, behind one interface (`reflection_operator`): `reference` by quadrature, `closed_form` by
formula, `network` by a learned correction of the formula, compiled where there is a C compiler, and `paper_network`, the
baseline, by networks that know no formula.

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
    """The operator `name`; each is imported when it is asked for.

    weights: folder with diffuse.safetensors and specular.safetensors, for the networks; None takes the shipped ones
    dtype:   float32 or float64; None takes the operator's own (float64 for the reference, float32 for the others)
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
