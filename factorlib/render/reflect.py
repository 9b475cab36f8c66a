"""Radiance of many surface points in a light of many lobes, by the reflection operator.

Occlusion scales each lobe by the share that a point sees (`factorlib.light.visibility`).  A light of finite distance
changes angles and weights for points away from the middle (`factorlib.light.distance`).  Both are as in the solve.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.distance import finite_distance_cosines
from factorlib.light.lobes import Lobes
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, visible_share
from factorlib.reflection import Operator
from factorlib.results.materials import Reflectance

PAIRS_AT_ONCE = 1 << 18  # pairs of a point and a lobe in one batch

Report = Callable[[float, float], None]  # points done, their total


def silently(done: float, total: float) -> None:
    """Ignore a progress report."""


class PointEffects(msgspec.Struct, frozen=True):
    """Effects that differ between points of a surface; None where a model has none.

    Attributes:
        visibility: visibility of the directions of `fibonacci_sphere(k)`, 0 hidden to 255 visible; None is all visible
        place: position relative to the middle, as `factorlib.light.distance` takes it; None is the middle
        detail: factor on the diffuse reflectance; None is 1
    """

    visibility: UInt8[np.ndarray, "n k"] | None = None
    place: Float[np.ndarray, "n 3"] | None = None
    detail: Float[np.ndarray, " n"] | None = None


class Reflector:
    """One light, reflected by any number of materials and points.

    The lobes are in the frame of the normals and views.
    """

    def __init__(self, operator: Operator, lobes: Lobes, curvature: float = 0.0):
        self.operator = operator
        self.curvature = curvature
        self.lobes = lobes.take(lobes.weight.max(axis=1) > 0)
        self.axis = self._tensor(self.lobes.axis)
        self.weight = self._tensor(self.lobes.weight)
        self.sharpness = self._tensor(self.lobes.sharpness)

    def __call__(
        self,
        material: Reflectance,
        normals: Float[np.ndarray, "n 3"],
        views: Float[np.ndarray, "n 3"],
        report: Report = silently,
        effects: PointEffects = PointEffects(),
    ) -> Float[np.ndarray, "n 3"]:
        """Return the radiance that points reflect toward the viewer; float64, zero where a normal faces away.

        Args:
            material: diffuse and specular reflectance, and roughness
            normals: unit normals
            views: unit directions toward the viewer
            report: receives the number of points done and their total
            effects: visibility, position and detail of the points
        """
        result = np.zeros((len(normals), 3))
        step = max(1, PAIRS_AT_ONCE // max(len(self.sharpness), 1))
        optional = msgspec.structs.astuple(effects)
        with torch.no_grad():
            for i in range(0, len(normals) if len(self.sharpness) else 0, step):
                rows = slice(i, i + step)
                tensors = (None if values is None else self._tensor(values[rows]) for values in optional)
                radiance = self._radiance(material, self._tensor(normals[rows]), self._tensor(views[rows]), *tensors)
                result[rows] = radiance.double().numpy()
                report(min(i + step, len(normals)), len(normals))
        return result

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=self.operator.dtype)

    def _radiance(
        self,
        material: Reflectance,
        normals: Float[Tensor, "n 3"],
        views: Float[Tensor, "n 3"],
        visibility: Float[Tensor, "n k"] | None,
        place: Float[Tensor, "n 3"] | None,
        detail: Float[Tensor, " n"] | None,
    ) -> Float[Tensor, "n 3"]:
        parts = material.diffuse, material.specular, material.roughness
        kd, ks, roughness = (torch.tensor(part, dtype=self.operator.dtype) for part in parts)
        # cosines n·o per point, n·z and o·z per point and lobe; shares of each lobe that a point receives
        no = (normals * views).sum(-1)
        nz = (normals @ self.axis.T).clamp(-1, 1)
        oz = (views @ self.axis.T).clamp(-1, 1)
        shares = (
            [1.0, 1.0] if visibility is None else self._visible_shares(visibility, normals, views, float(roughness))
        )
        if place is not None and self.curvature > 0:
            nz, oz, larger = finite_distance_cosines(place, normals, views, self.axis, self.curvature)
            shares = [larger * share for share in shares]
        # diffuse part plus specular part, summed over lobes
        radiance = kd * ((shares[0] * self.operator.diffuse(self.sharpness, nz)) @ self.weight)
        if detail is not None:
            radiance = radiance * detail[:, None]
        if bool(ks.any()):
            specular = self.operator.specular(roughness, self.sharpness, no, nz, oz)
            radiance = radiance + ks * ((shares[1] * specular) @ self.weight)
        return torch.where(no[:, None] > 0, radiance, torch.zeros_like(radiance))

    def _visible_shares(
        self, visibility: Tensor, normals: Tensor, views: Tensor, roughness: float
    ) -> list[Float[Tensor, "n p"]]:
        """Return the visible shares of the diffuse and of the specular reflection of each lobe."""
        directions = torch.from_numpy(fibonacci_sphere(visibility.shape[1])).float()
        visibility = visibility.float() / 255
        normals = normals.float()
        views = views.float()
        lobes = kernel(directions, self.axis.float(), self.sharpness.float())
        weights = cosine_weights(normals, directions), highlight_weights(normals, views, directions, roughness)
        return [visible_share(visibility, weight, lobes).to(self.operator.dtype) for weight in weights]
