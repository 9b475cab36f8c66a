"""One illumination of the joint problem at a point: what its photos show, and what the model says they should.

    predicted  y_ic = τ_i(e_i Σ_p w_pc B_ipc + G_ic),   B_ipc = k_d,c D_ip + k_s,c S_ip,   G_ic = k_d,c G_d,ic + k_s,c G_s,ic,   τ the tone curve
    residual   r_ic = (y_ic − radiance_ic) / σ_ic; where the channel is clipped min(r_ic, 0), for the true radiance may be higher

D and S are the responses of `factorlib.model.responses`, G is what other surfaces send (`factorlib.model.interreflection`).  These two modules are where a new physical effect is added.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.model.blocks import Block
from factorlib.model.jacobian import Linearised, linearised
from factorlib.model.lights import Light, UnitLobes
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.responses import Responses, Rows, bounced_of, material_slices, radiance_of, responses, unit_values
from factorlib.model.tone import slope_at, toned
from factorlib.reflection.operator import Operator


class Illumination(msgspec.Struct, frozen=True):
    """The observations in one light, that light, the materials and the reflection operator; radiance is in the block's unit."""

    block: Block
    light: Light
    materials: Materials
    operator: Operator

    @property
    def exposure(self) -> Float[np.ndarray, "n 1"]:
        """The factor of each observation's photo on the light."""
        return np.exp(self.light.log_exposure)[self.block.photo][:, None]

    def fitted(self) -> Illumination:
        """With the observations alone that are not held out."""
        return msgspec.structs.replace(self, block=self.block.fitted())

    def with_light(self, light: Light) -> Illumination:
        """The same observations and materials in another light."""
        return msgspec.structs.replace(self, light=light)

    @property
    def unknowns(self) -> Int[np.ndarray, " k+l"]:
        """Numbers of the unknowns on which its radiance depends, ascending: 7 of each material that it shows, then the light's l."""
        shown = 7 * np.unique(self.block.material)[:, None] + np.arange(7)
        return np.concatenate([shown.reshape(-1), 7 * len(self.materials) + np.arange(self.light.unknowns)])

    def lit(self, rows: Rows, roughness: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Σ_p D w and Σ_p S w at `rows`: radiance of a material of that roughness with k_d = 1 and with k_s = 1, before exposure, without bounces."""
        parts = unit_values(self.block, rows, self.light.unit_lobes, roughness, self.operator)
        diffuse, specular = (part @ self.light.weight for part in parts)
        return diffuse, specular

    def radiance(self) -> Float[np.ndarray, "n 3"]:
        """y: what every observation should show."""
        linear, exposure = np.zeros_like(self.block.radiance), self.exposure
        for m, rows in material_slices(self.block):
            parts = self.lit(rows, float(self.materials.roughness[m]))
            linear[rows] = radiance_of(exposure[rows], self.materials.diffuse[m], self.materials.specular[m], *parts)
            linear[rows] += bounced_of(self.block, rows, self.materials, m)
        return toned(linear, self.light, self.block.photo)

    def residuals(self) -> Float[np.ndarray, "n 3"]:
        """r, in σ of the noise model."""
        return self.block.residuals(self.radiance())

    def losses(self, loss: Loss) -> Float[np.ndarray, " n"]:
        """Robust loss of every observation, mean over its channels."""
        return loss.of_residuals(self.residuals()).mean(1)

    def fit_loss(self, loss: Loss) -> float:
        """The loss of the observations that are not held out, with priors."""
        residual = self.residuals()[~self.block.held_out]
        return float(np.sum(loss.of_residuals(residual))) + loss.of_light(self.block, self.light).value

    def responses(self) -> Iterator[Responses]:
        """D and S of all observations, with derivatives, in chunks of rows."""
        return responses(self.block, self.light, self.materials, self.operator)

    def linearise(self, loss: Loss, known: Iterable[Responses] | None = None) -> Iterator[Linearised]:
        """Whitened residuals and their Jacobian, in chunks of rows and channel by channel; known: `responses`, if computed before."""
        for some in self.responses() if known is None else known:
            yield from linearised(self.block, self.light, self.materials, some, loss)

    def atoms(self, rows: Int[np.ndarray, " n"], lobes: UnitLobes) -> Float[np.ndarray, "3 n q"]:
        """What q further lobes of weight one would add to the whitened residuals at `rows`, per channel."""
        block, materials = self.block, self.materials
        diffuse = np.empty((len(rows), len(lobes)))
        specular = np.empty_like(diffuse)
        for m in np.unique(block.material[rows]):
            of = block.material[rows] == m
            diffuse[of], specular[of] = unit_values(block, rows[of], lobes, float(materials.roughness[m]), self.operator)
        scale = block.precision[rows] * slope_at(block.radiance[rows], self.light, block.photo[rows])
        scale *= self.exposure[rows]
        material = block.material[rows]
        return np.stack([
            scale[:, c, None] * (materials.diffuse[material, c, None] * diffuse + materials.specular[material, c, None] * specular)
            for c in range(3)
        ])  # fmt: skip
