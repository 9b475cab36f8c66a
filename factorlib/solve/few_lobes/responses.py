"""What rows of observations reflect of few lobes of weight one, with all derivatives: D and S of `factorlib.model.responses`, exposed.

Self-shadowing multiplies responses as in `factorlib.model.shadowing`; here its derivatives follow by the product rule.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.light.visibility import MovingLobes, Seen, cosine_weights, highlight_weights, seen
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination, material_slices
from factorlib.model.lights import Light, UnitLobes, tangents
from factorlib.model.materials import Materials
from factorlib.model.responses import Rows, cosines
from factorlib.model.shadowing import shadowed_rows


class Turning(msgspec.Struct, frozen=True):
    """Derivatives [n, p] of the responses by turns of their lobes toward the two tangents, through visibility alone."""

    diffuse: tuple[Tensor, Tensor]
    specular: tuple[Tensor, Tensor]


class Responses(msgspec.Struct, frozen=True):
    """What `rows` of one material reflect of each lobe of weight one, with shadows and exposure, and the derivatives.

    parts    the fields of the operator's Response [n, p]
    turning  how shadows alone change them as lobes turn; None without shadows
    """

    material: int
    rows: slice
    parts: dict[str, Float[Tensor, "n p"]]
    turning: Turning | None

    def basis(self, materials: Materials, c: int) -> Float[Tensor, "n p"]:
        """Radiance in channel c by the lobes' weights there: k_d D + k_s S, exposed."""
        return (
            materials.diffuse[self.material, c] * self.parts["diffuse"]
            + materials.specular[self.material, c] * self.parts["specular"]
        )


def responses(illumination: Illumination) -> Iterator[Responses]:
    """The responses of all observations of an illumination, in chunks of rows."""
    block, light, materials, operator = (
        illumination.block,
        illumination.light,
        illumination.materials,
        illumination.operator,
    )
    for m, rows in material_slices(block):
        roughness = float(materials.roughness[m])
        exposure = torch.from_numpy(np.exp(light.log_exposure)[block.photo[rows]])[:, None]
        response = operator.response(*operator_inputs(block, rows, light.unit_lobes, roughness, operator.dtype))
        parts = {name: getattr(response, name).double() * exposure for name in response.__struct_fields__}
        yield Responses(m, rows, *shadowed_response(parts, block, rows, light, roughness))


def operator_inputs(block: Block, rows: Rows, lobes: UnitLobes, roughness: float, dtype: torch.dtype) -> list[Tensor]:
    """roughness, λ, n·o, n·z, o·z of lobes at the observations `rows`, as an operator of that `dtype` takes them."""
    inputs = np.float64(roughness), lobes.sharpness, *cosines(block.normal[rows], block.view[rows], lobes.axis)
    return [torch.as_tensor(value).to(dtype) for value in inputs]


def bounced_of(block: Block, rows: Rows, materials: Materials, m: int) -> Float[np.ndarray, "n 3"] | float:
    """What other surfaces send to `rows`, which show material m, and these reflect; 0 for a block without bounces."""
    if block.bounced is None:
        return 0.0
    sent = block.bounced[rows]
    return materials.diffuse[m] * sent[:, :3] + materials.specular[m] * sent[:, 3:]


def shadowed_response(
    r: dict[str, Tensor], block: Block, rows: slice, light: Light, roughness: float
) -> tuple[dict[str, Tensor], Turning | None]:
    """The fields [n, p] of an operator's Response with shadows, by the product rule, and how shadows change as lobes turn."""
    if block.visibility is None:
        return r, None
    r = {name: value.clone() for name, value in r.items()}
    turning = Turning(*(tuple(torch.zeros_like(r["diffuse"]) for _ in range(2)) for _ in range(2)))
    axis, sharpness, *toward = (
        torch.from_numpy(v).float() for v in (light.axis, light.sharpness, *tangents(light.axis))
    )
    lobes = MovingLobes(axis, sharpness, tuple(toward))
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
