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

from factorlib.light.visibility import MovingLobes, Seen, cosine_weights, highlight_weights, kernel, seen, seen_share
from factorlib.model.blocks import Block
from factorlib.model.lights import Light, UnitLobes

TOGETHER = 512  # observations whose visibility a processor's cache holds


class Turning(msgspec.Struct, frozen=True):
    """Derivatives [n, p] of the responses by turns of their lobes toward the two tangents, through visibility alone."""

    diffuse: tuple[Tensor, Tensor]
    specular: tuple[Tensor, Tensor]


class Rows(msgspec.Struct, frozen=True):
    """Observations of one photo from which something is hidden: their places among the rows asked for, and what they see (0 to 1)."""

    places: Tensor
    visibility: Float[Tensor, "n k"]
    normal: Float[Tensor, "n 3"]
    view: Float[Tensor, "n 3"]
    directions: Float[Tensor, "k 3"]


def shadowed_rows(block: Block, rows: slice | Int[np.ndarray, " n"]) -> Iterator[Rows]:
    """Those of `rows` from which something is hidden, photo by photo, at most TOGETHER at once."""
    visibility, photo = block.visibility[rows], block.photo[rows]
    hidden = (visibility < 255).any(1)
    for k in np.unique(photo[hidden]):
        directions, places = torch.from_numpy(block.directions[k]).float(), np.flatnonzero(hidden & (photo == k))
        for some in np.split(places, range(TOGETHER, len(places), TOGETHER)):
            normal, view = (torch.from_numpy(v[rows][some]).float() for v in (block.normal, block.view))
            yield Rows(torch.from_numpy(some), torch.from_numpy(visibility[some]).float() / 255, normal, view, directions)


def shadowed(
    parts: tuple[Tensor, Tensor], block: Block, rows: slice | Int[np.ndarray, " n"], lobes: UnitLobes, roughness: float
) -> tuple[Tensor, Tensor]:
    """The responses `parts` = (diffuse, specular) [n, p] to lobes at `rows`, with shadows."""
    if block.visibility is None:
        return parts
    diffuse, specular = (part.clone() for part in parts)
    axis, sharpness = (torch.from_numpy(v).float() for v in (lobes.axis, lobes.sharpness))
    for some in shadowed_rows(block, rows):
        light = kernel(some.directions, axis, sharpness)
        glossy, _ = highlight_weights(some.normal, some.view, some.directions, float(roughness))
        diffuse[some.places] *= seen_share(some.visibility, cosine_weights(some.normal, some.directions), light).to(diffuse.dtype)
        specular[some.places] *= seen_share(some.visibility, glossy, light).to(specular.dtype)
    return diffuse, specular


def shadowed_response(
    r: dict[str, Tensor], block: Block, rows: slice, light: Light, roughness: float
) -> tuple[dict[str, Tensor], Turning | None]:
    """The fields [n, p] of an operator's Response with shadows, by the product rule, and how shadows change as lobes turn."""
    if block.visibility is None:
        return r, None
    r = {name: value.clone() for name, value in r.items()}
    turning = Turning(*(tuple(torch.zeros_like(r["diffuse"]) for _ in range(2)) for _ in range(2)))
    axis, sharpness, *tangents = (torch.from_numpy(v).float() for v in (light.axis, light.sharpness, *light.tangents()))
    lobes = MovingLobes(axis, sharpness, tuple(tangents))
    for some in shadowed_rows(block, rows):
        glossy, by_roughness = highlight_weights(some.normal, some.view, some.directions, float(roughness))
        cosine = cosine_weights(some.normal, some.directions)
        for part, weights, rough in (("diffuse", cosine, None), ("specular", glossy, by_roughness)):
            share = seen(some.visibility, weights, some.directions, lobes, rough)
            _multiply(r, getattr(turning, part), part, some.places, share)
    return r, turning


def _multiply(r: dict[str, Tensor], turning: tuple[Tensor, Tensor], part: str, places: Tensor, share: Seen) -> None:
    whole = r[part][places]
    for name in r:
        if name.startswith(part):
            r[name][places] *= share.share
    r[f"{part}_by_log_sharpness"][places] += whole * share.by_log_sharpness
    if share.by_roughness is not None:
        r[f"{part}_by_roughness"][places] += whole * share.by_roughness
    for target, slope in zip(turning, (share.by_first, share.by_second), strict=True):
        target[places] = whole * slope
