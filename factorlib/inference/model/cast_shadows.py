"""Shadows on the ground, as observations of a light.

`factorlib.urm.cast_shadows` says how much darker patches of the ground are than if nothing shadowed them.  Of a diffuse
ground that is q_i = E_i/F_i, in each channel, whatever its reflectance and its exposure:

    E_i = Σ_p v_ip D_ip w_p,     F_i = Σ_p D_ip w_p,     ∂(E_i/F_i)/∂w_p = (v_ip − E_i/F_i) D_ip/F_i              (1)

with D_ip the diffuse response of patch i to lobe p, v_ip the share of it that shadows leave, and w the weights of a
light.  Light that objects send to the ground, and tone curves, are neglected.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.inference.model.blocks import Block, RobustLoss
from factorlib.inference.model.lights import UnitLobes
from factorlib.inference.model.responses import diffuse_response
from factorlib.reflection.operator import Operator

LEAST_VARIANCE = 1e-8  # of ratios that are not constant


class CastShadows(msgspec.Struct, frozen=True):
    """Responses of n patches of the ground to the p lobes of a light.

    Attributes:
        shadowed: v D of (1).
        open: D.
        ratio: q.
        inverse_sigma: 1/σ of q.
    """

    shadowed: Float[np.ndarray, "n p"]
    open: Float[np.ndarray, "n p"]
    ratio: Float[np.ndarray, "n 3"]
    inverse_sigma: Float[np.ndarray, "n 3"]

    def gradient(
        self, weight: Float[np.ndarray, "p 3"], loss: RobustLoss, temperature: float
    ) -> tuple[float, Float[np.ndarray, "p 3"]]:
        """Return the robust loss Σ ρ(r)/T, and half its gradient by the logarithms of the weights."""
        predicted, whole, residual = self._predict(weight)
        by_ratio = loss.weights(residual) * residual * self.inverse_sigma / whole / temperature
        by_weight = self.shadowed.T @ by_ratio - self.open.T @ (by_ratio * predicted)
        return float(loss.evaluate(residual).sum()) / temperature, by_weight * weight

    def linearise(
        self, weight: Float[np.ndarray, "p 3"], loss: RobustLoss, temperature: float
    ) -> Iterator[tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"]]]:
        """Yield ∂r/∂log w and r of each channel, weighted by the robust loss and divided by √T, float32."""
        predicted, whole, residual = self._predict(weight)
        pull = np.sqrt(loss.weights(residual) / temperature)
        scale = pull * self.inverse_sigma / whole
        for c in range(3):
            slope = self.shadowed - predicted[:, c, None] * self.open
            jacobian = (scale[:, c, None] * slope * weight[:, c]).astype(np.float32)
            yield jacobian, (pull * residual)[:, c].astype(np.float32)

    def correlation(self, weight: Float[np.ndarray, "p 3"]) -> float:
        """Return the correlation of E/F and q, means over channels, weighted by 1/σ²; 0 where one is constant."""
        predicted, _, _ = self._predict(weight)
        both = np.stack([predicted.mean(1), self.ratio.mean(1)])
        covariance = np.cov(both, aweights=np.square(self.inverse_sigma).mean(1))
        scale = float(np.sqrt(covariance[0, 0] * covariance[1, 1]))
        return float(covariance[0, 1]) / scale if scale > LEAST_VARIANCE else 0.0

    def _predict(self, weight: Float[np.ndarray, "p 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return E/F, F and the residuals r."""
        whole = self.open @ weight
        predicted = self.shadowed @ weight / whole
        return predicted, whole, (predicted - self.ratio) * self.inverse_sigma


def cast_shadows(ground: Block, lobes: UnitLobes, operator: Operator) -> CastShadows:
    """Return the responses of the ground of a light's photos to its lobes."""
    rows = slice(None)
    shadowed, whole = (
        diffuse_response(each, rows, lobes, operator) for each in (ground, ground.with_effects(False, False))
    )
    return CastShadows(shadowed, whole, ground.radiance * ground.unit, ground.inverse_sigma / ground.unit)
