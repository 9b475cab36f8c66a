"""Radiance of many surface points in a light of many lobes, as the reflection operator gives it.

About half of the lobes lie behind a surface.  Points are taken in the order of their normals, so many at a time, and the operator and the
visibility are asked for those lobes and directions alone that are in front of some of them.

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

from factorlib.geometry.sphere import direction_cells
from factorlib.light.distance import met_from
from factorlib.light.lobes import Lobes
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, seen_share
from factorlib.reflection import Operator
from factorlib.reflection.operator import MaterialLike

PAIRS_AT_ONCE = 1 << 17  # of a point and a lobe
CELL = 0.3  # radians: normals of one cell are neighbours in the order
BEHIND = 2.0  # standard deviations 1/√λ below the horizon, at which a lobe is out of sight

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


class Patch(msgspec.Struct, frozen=True):
    """n points that are computed together; place, detail, shadows: as `Reflector` takes them."""

    normals: Float[Tensor, "n 3"]
    views: Float[Tensor, "n 3"]
    place: Float[Tensor, "n 3"] | None
    detail: Float[Tensor, "n 1"] | float
    shadows: Shadows | None


class Reflector:
    """One light, seen by any number of materials and points; `lobes` in the frame of the normals and views."""

    def __init__(self, operator: Operator, lobes: Lobes, curvature: float = 0.0):
        self.operator, self.curvature = operator, curvature
        self.lobes = lobes.take(lobes.weight.max(axis=1) > 0)
        self.axis, self.weight = self._tensor(self.lobes.axis), self._tensor(self.lobes.weight)
        self.sharpness = self._tensor(self.lobes.sharpness)

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
        result, done = np.zeros((len(normals), 3)), 0
        if not len(normals) or not len(self.sharpness):
            return result
        lobes = None if shadows is None else self._lobes_at(shadows.directions)
        order, step = np.lexsort(direction_cells(normals, CELL).T), max(1, PAIRS_AT_ONCE // len(self.sharpness))
        with torch.no_grad():
            for rows in np.split(order, range(step, len(order), step)):
                patch = Patch(
                    self._tensor(normals[rows]),
                    self._tensor(views[rows]),
                    None if place is None or self.curvature == 0 else self._tensor(place[rows]),
                    1.0 if detail is None else self._tensor(detail[rows, None]),
                    None if shadows is None else shadows.take(rows),
                )
                result[rows] = self._radiance(material, patch, lobes).double().numpy()
                done += len(rows)
                report(done, len(order))
        return result

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=self.operator.dtype)

    def _lobes_at(self, directions: Float[np.ndarray, "k 3"]) -> Float[Tensor, "k p"]:
        """Return what `seen_share` takes of every lobe."""
        return kernel(torch.from_numpy(directions).float(), self.axis.float(), self.sharpness.float())

    def _radiance(
        self, material: MaterialLike, patch: Patch, lobes: Float[Tensor, "k p"] | None
    ) -> Float[Tensor, "n 3"]:
        """The sum over lobes; lobes: `_lobes_at` the directions of the patch's shadows."""
        of_material = material.diffuse, material.specular, material.roughness
        kd, ks, roughness = (torch.tensor(of, dtype=self.operator.dtype) for of in of_material)
        normals, views = patch.normals, patch.views
        no, nz, oz = (normals * views).sum(-1), (normals @ self.axis.T).clamp(-1, 1), (views @ self.axis.T).clamp(-1, 1)
        larger = torch.ones_like(nz)
        if patch.place is not None:
            nz, oz, larger = met_from(patch.place, normals, views, self.axis, self.curvature)
        # lobes that reach above the horizon of some point
        front = (nz > -BEHIND * torch.rsqrt(self.sharpness)).any(0)
        nz, oz, larger, sharpness, weight = nz[:, front], oz[:, front], larger[:, front], self.sharpness[front], self.weight[front]
        diffuse_seen, specular_seen = larger, larger
        if lobes is not None:
            shares = self._seen(patch, float(material.roughness), lobes[:, front])
            diffuse_seen, specular_seen = larger * shares[0], larger * shares[1]
        radiance = kd * patch.detail * ((diffuse_seen * self.operator.diffuse(sharpness, nz)) @ weight)
        if bool(ks.any()):
            specular = self.operator.specular(roughness, sharpness, no, nz, oz)
            radiance = radiance + ks * ((specular_seen * specular) @ weight)
        return torch.where(no[:, None] > 0, radiance, torch.zeros_like(radiance))

    def _seen(self, patch: Patch, roughness: float, lobes: Float[Tensor, "k p"]) -> list[Float[Tensor, "n p"]]:
        """Shares of the diffuse and of the specular reflection of each lobe."""
        visibility, directions = (
            torch.from_numpy(each).float() for each in (patch.shadows.visibility, patch.shadows.directions)
        )
        normals, views = patch.normals.float(), patch.views.float()
        weights = cosine_weights(normals, directions), highlight_weights(normals, views, directions, roughness)
        front = (weights[0] > 0).any(0)
        visibility, lobes = visibility[:, front] / 255, lobes[front]
        return [seen_share(visibility, of[:, front], lobes).to(self.operator.dtype) for of in weights]
