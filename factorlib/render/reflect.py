"""Radiance of many surface points in a light of many lobes, as the reflection operator gives it, but sooner.

Two facts save most of the operator's work.

Diffuse    A lobe's diffuse reflection is a smooth function of n·z alone: the operator fills a table per lobe.
Specular   At each point a few lobes make up nearly all of the radiance.  The operator computes these; the closed form,
           25 times cheaper, tells which they are, and stands for the others.  Together the others are at most `tail`
           of the point's radiance in every channel, and the closed form errs by about a fifth of that.
           tail = 0: the operator throughout.

Points that do not see every direction (`Shadows`) reflect of each lobe what they see, and points beside the middle meet a light of
finite distance as `factorlib.light.distance` says, as in the solve.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from factorlib.light.distance import met_from
from factorlib.light.lobes import Lobes
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, seen_share
from factorlib.reflection import Operator, reflection_operator
from factorlib.reflection.operator import MaterialLike

TAIL = 0.005
NODES = 1024  # of n·z in a lobe's table
PAIRS_AT_ONCE = 1 << 17  # of a point and a lobe: about 200 MB in the networks

Report = Callable[[float, float], None]  # of points done, of how many


def silently(done: float, total: float) -> None:
    """The report to nobody."""


class Shadows(msgspec.Struct, frozen=True):
    """What n points see of k directions, 0 to 255; directions in the frame of their normals.

    which: row of `visibility` that each point sees as, so that many points can share one; None: each has its own
    """

    visibility: UInt8[np.ndarray, "m k"]
    directions: Float[np.ndarray, "k 3"]
    which: Int[np.ndarray, " n"] | None = None

    def take(self, rows: slice | np.ndarray) -> Shadows:
        """Those of some points, a row for each."""
        return Shadows(self.visibility[rows if self.which is None else self.which[rows]], self.directions)


class Reflector:
    """One light, seen by any number of materials and points; `lobes` in the frame of the normals and views."""

    def __init__(self, operator: Operator, lobes: Lobes, tail: float = TAIL, curvature: float = 0.0):
        lit = lobes.weight.max(axis=1) > 0
        self.curvature = curvature
        self.operator, self.cheap, self.tail = operator, reflection_operator("closed_form"), tail
        self.axis, self.weight = (self._tensor(field[lit]) for field in (lobes.axis, lobes.weight))
        self.sharpness = self._tensor(lobes.sharpness[lit])
        self.table = self._diffuse_table()

    def __call__(
        self,
        material: MaterialLike,
        normals: Float[np.ndarray, "n 3"],
        views: Float[np.ndarray, "n 3"],
        report: Report = silently,
        shadows: Shadows | None = None,
        place: Float[np.ndarray, "n 3"] | None = None,
        detail: Float[np.ndarray, " n"] | None = None,
    ) -> Float[np.ndarray, "n 3"]:
        """Radiance toward unit `views` of points with unit `normals`; float64, zero where a normal faces away.

        place: None is the middle;  detail: factor on the diffuse reflectance, None is 1
        """
        result, step = np.zeros((len(normals), 3)), max(1, PAIRS_AT_ONCE // max(len(self.sharpness), 1))
        with torch.no_grad():
            for i in range(0, len(normals) if len(self.sharpness) else 0, step):
                rows = slice(i, i + step)
                some = None if shadows is None else shadows.take(rows)
                x = None if place is None or self.curvature == 0 else self._tensor(place[rows])
                geometry = self._tensor(normals[rows]), self._tensor(views[rows]), x
                factor = None if detail is None else self._tensor(detail[rows])
                result[rows] = self._radiance(material, *geometry, some, factor).double().numpy()
                report(min(i + step, len(normals)), len(normals))
        return result

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=self.operator.dtype)

    def _radiance(
        self,
        material: MaterialLike,
        normals: Tensor,
        views: Tensor,
        place: Tensor | None,
        shadows: Shadows | None,
        detail: Tensor | None,
    ) -> Float[Tensor, "n 3"]:
        kd, ks = (torch.tensor(k, dtype=self.operator.dtype) for k in (material.diffuse, material.specular))
        no, nz, oz = (normals * views).sum(-1), (normals @ self.axis.T).clamp(-1, 1), (views @ self.axis.T).clamp(-1, 1)
        diffuse_seen, specular_seen = (
            (1.0, 1.0) if shadows is None else self._seen(shadows, normals, views, float(material.roughness))
        )
        if place is not None:
            nz, oz, larger = met_from(place, normals, views, self.axis, self.curvature)
            diffuse_seen, specular_seen = larger * diffuse_seen, larger * specular_seen
        radiance = kd * ((diffuse_seen * self._diffuse(nz)) @ self.weight)
        if detail is not None:
            radiance = radiance * detail[:, None]
        if bool(ks.any()):
            roughness = torch.tensor(material.roughness, dtype=self.operator.dtype)
            specular = specular_seen * self._specular(roughness, ks, no, nz, oz, radiance)
            radiance = radiance + ks * (specular @ self.weight)
        return torch.where(no[:, None] > 0, radiance, torch.zeros_like(radiance))

    def _seen(self, shadows: Shadows, normals: Tensor, views: Tensor, roughness: float) -> tuple[Tensor, Tensor]:
        """Shares of the diffuse and of the specular reflection of each lobe, [n, p]."""
        visibility, directions = (torch.from_numpy(each).float() for each in (shadows.visibility, shadows.directions))
        visibility, normals, views = visibility / 255, normals.float(), views.float()
        lobes = kernel(directions, self.axis.float(), self.sharpness.float())
        weights = cosine_weights(normals, directions), highlight_weights(normals, views, directions, roughness)
        diffuse, specular = (seen_share(visibility, weight, lobes).to(self.operator.dtype) for weight in weights)
        return diffuse, specular

    # diffuse ----------------------------------------------------------------------------------------------------------

    def _diffuse_table(self) -> Float[Tensor, "nodes p"]:
        """The operator at n·z = −1 … 1."""
        nz = torch.linspace(-1, 1, NODES, dtype=self.operator.dtype)[:, None].expand(NODES, len(self.sharpness))
        with torch.no_grad():
            return self.operator.diffuse(self.sharpness, nz)

    def _diffuse(self, nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Linear interpolation in the table."""
        at = (nz + 1) / 2 * (NODES - 1)
        low = at.floor().clamp(0, NODES - 2)
        first = torch.gather(self.table, 0, low.long())
        return first + (at - low) * (torch.gather(self.table, 0, low.long() + 1) - first)

    # specular ---------------------------------------------------------------------------------------------------------

    def _specular(
        self, roughness: Tensor, ks: Tensor, no: Tensor, nz: Tensor, oz: Tensor, diffuse: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n p"]:
        if self.tail == 0:
            return self.operator.specular(roughness, self.sharpness, no, nz, oz)
        value = self.cheap.specular(roughness, self.sharpness, no, nz, oz)
        share = self._shares(value, ks, diffuse + ks * (value @ self.weight))
        chosen = largest(share, torch.full_like(no, self.tail)) & (no > 0)[:, None]
        point, lobe = chosen.nonzero(as_tuple=True)
        pairs = self.sharpness[lobe][:, None], no[point], nz[point, lobe][:, None], oz[point, lobe][:, None]
        value[point, lobe] = self.operator.specular(roughness, *pairs)[:, 0]
        return value

    def _shares(
        self, specular: Float[Tensor, "n p"], ks: Tensor, radiance: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n p"]:
        """Each lobe's highlight over the point's radiance, in the channel where that is most."""
        most = torch.zeros_like(specular)
        for c in range(3):
            most = torch.maximum(most, ks[c] * self.weight[:, c] / radiance[:, c : c + 1].clamp_min(1e-30))
        return specular * most


def largest(values: Float[Tensor, "n p"], rest: Float[Tensor, " n"]) -> Bool[Tensor, "n p"]:
    """The largest values of each row, as few as leave a sum of at most `rest`.

    >>> largest(torch.tensor([[1.0, 5.0, 0.5, 3.0]]), torch.tensor([2.0])).tolist()
    [[False, True, False, True]]
    """
    ascending, order = values.sort(dim=-1)
    return torch.zeros_like(values, dtype=torch.bool).scatter(-1, order, ascending.cumsum(-1) > rest[:, None])
