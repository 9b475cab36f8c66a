"""Self-shadowing: the share of each lobe's reflection that is left where meshes hide a part of the light.

    D_ip → v_ip D_ip,   S_ip → u_ip S_ip          with v, u of factorlib.light.visibility, (1) and (2)

All responses of the model pass through here (`factorlib.model.responses`).  A block without visibility passes unchanged, at no cost.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, seen_share
from factorlib.model.blocks import Block
from factorlib.model.lights import UnitLobes

TOGETHER = 512  # observations whose visibility a processor's cache holds


class Shadowed(msgspec.Struct, frozen=True):
    """Observations of one photo from which something is hidden: their places among the rows asked for, and what they see (0 to 1)."""

    places: Tensor
    visibility: Float[Tensor, "n k"]
    normal: Float[Tensor, "n 3"]
    view: Float[Tensor, "n 3"]
    directions: Float[Tensor, "k 3"]


def shadowed_rows(block: Block, rows: slice | Int[np.ndarray, " n"]) -> Iterator[Shadowed]:
    """Those of `rows` from which something is hidden, photo by photo, at most TOGETHER at once."""
    visibility, photo = block.visibility[rows], block.photo[rows]
    hidden = (visibility < 255).any(1)
    for k in np.unique(photo[hidden]):
        directions, places = torch.from_numpy(block.directions[k]).float(), np.flatnonzero(hidden & (photo == k))
        for some in np.split(places, range(TOGETHER, len(places), TOGETHER)):
            normal, view = (torch.from_numpy(v[rows][some]).float() for v in (block.normal, block.view))
            yield Shadowed(
                torch.from_numpy(some), torch.from_numpy(visibility[some]).float() / 255, normal, view, directions
            )


def shadowed_diffuse(response: Tensor, block: Block, rows: slice | Int[np.ndarray, " n"], lobes: UnitLobes) -> Tensor:
    """The diffuse response [n, p] to lobes at `rows`, with shadows."""
    if block.visibility is None:
        return response
    response = response.clone()
    axis, sharpness = (torch.from_numpy(v).float() for v in (lobes.axis, lobes.sharpness))
    for some in shadowed_rows(block, rows):
        weights = cosine_weights(some.normal, some.directions)
        share = seen_share(some.visibility, weights, kernel(some.directions, axis, sharpness))
        response[some.places] *= share.to(response.dtype)
    return response


def shadowed_specular(
    response: Tensor, block: Block, rows: slice | Int[np.ndarray, " n"], lobes: UnitLobes, roughness: float
) -> Tensor:
    """The specular response [n, p] to lobes at `rows`, for a material of that roughness, with shadows."""
    if block.visibility is None:
        return response
    response = response.clone()
    axis, sharpness = (torch.from_numpy(v).float() for v in (lobes.axis, lobes.sharpness))
    for some in shadowed_rows(block, rows):
        weights = highlight_weights(some.normal, some.view, some.directions, float(roughness))
        share = seen_share(some.visibility, weights, kernel(some.directions, axis, sharpness))
        response[some.places] *= share.to(response.dtype)
    return response
