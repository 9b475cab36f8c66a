"""Forward model of one illumination: predicted radiance of its photos, residuals and all derivatives.

    linear     ℓ_ic = k_d,c (e_i Σ_p D_ip w_pc + G_d,ic) + k_s,c (e_i Σ_p S_ip w_pc + G_s,ic),   w_p = peak_p exp(u_p)
    predicted  y_ic = τ_i(ℓ_ic) + (∂y/∂η)_ic η, τ the photo's tone curve, η turns of normals
    residual   r_ic = (y_ic − radiance_ic) / σ_ic

A clipped channel has the residual min(r_ic, 0), because its true radiance may be higher.  D and S are the responses of
`factorlib.inference.model.responses`, e is the photo's exposure, and G is the radiance that other surfaces send
(`factorlib.inference.model.interreflection`).  G comes from observed radiance and is added before the tone curve, an
approximation in photos with curves.  A new physical effect enters `predict`, `unit_responses`, `gradient`, `linearise`
and `_by_photos`, whose derivatives are written by hand and tested by finite differences.

The unknowns are log k_d, log k_s (RGB each) and roughness of a material, u of every cell and channel, log exposures and
log tone exponents.  A channel's residuals depend on the cells of that channel alone, so the Jacobian is one dense block
a channel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.images.tone import by_log_exponent
from factorlib.inference.model.blocks import Block, RobustLoss
from factorlib.inference.model.lights import Light, UnitLobes
from factorlib.inference.model.materials import REFLECTANCES, UNKNOWNS, Materials
from factorlib.inference.model.responses import (
    CHUNK,
    ResponseLookup,
    Responses,
    apply_shadows,
    diffuse_response,
    lobe_cosines,
    specular_response,
)
from factorlib.reflection.operator import Operator

NORMAL_STEP = 1e-3  # step of a normal, at which responses are linear and shadows are computed anew


class Prediction(NamedTuple):
    """Prediction of the model for n observations.

    Attributes:
        diffuse: Factor of k_d in ℓ.
        specular: Factor of k_s in ℓ.
        by_roughness: ∂specular/∂roughness; zeros without a table.
        linear: ℓ.
        radiance: y.
        responses: Material, its rows and its responses; empty without a table.
    """

    diffuse: Float[np.ndarray, "n 3"]
    specular: Float[np.ndarray, "n 3"]
    by_roughness: Float[np.ndarray, "n 3"]
    linear: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    responses: list[tuple[int, slice, Responses]]


class Linearised(NamedTuple):
    """Linearisation of one channel of one material's observations, float32.

    Rows are whitened, weighted by the robust loss and divided by √T.

    Attributes:
        channel: Number of the channel.
        rows: The n observations, as rows of the block.
        places: Indices of log k_d, log k_s and roughness among the material unknowns.
        diffuse: Diffuse part of ∂r/∂u of the channel's p free cells.
        specular: Specular part of ∂r/∂u.
        by_roughness: ∂²r/∂u ∂roughness.
        by_material: ∂r with respect to log k_d, log k_s and roughness.
        by_photo: ∂r with respect to turns of normals, the free log exposures, the log tone exponents and, where it is
            free, the log of the factor on fixed cells.  The first photo's exposure is fixed.
        residual: r.
    """

    channel: int
    rows: slice
    places: Int[np.ndarray, "3"]
    diffuse: Float[np.ndarray, "n p"]
    specular: Float[np.ndarray, "n p"]
    by_roughness: Float[np.ndarray, "n p"]
    by_material: Float[np.ndarray, "n 3"]
    by_photo: Float[np.ndarray, "n q"]
    residual: Float[np.ndarray, " n"]


class Gradient(NamedTuple):
    """Loss of one light, and half its gradient by the unknowns of all m materials and by those of the light."""

    value: float
    by_materials: Float[np.ndarray, "m 7"]
    by_light: Float[np.ndarray, " l"]


class Illumination(msgspec.Struct, frozen=True):
    """Observations under one light, that light, the materials and the reflection operator.

    Radiance is in the block's unit.

    Attributes:
        block: Observations.
        light: Light.
        materials: Materials.
        operator: Reflection operator.
        table: Responses of this block to the lobes of this light; None to evaluate the operator itself.
    """

    block: Block
    light: Light
    materials: Materials
    operator: Operator
    table: ResponseLookup | None = None

    @property
    def exposure(self) -> Float[np.ndarray, "n 1"]:
        """Exposure of each observation's photo, a factor on the light."""
        return np.exp(self.light.log_exposure)[self.block.photo][:, None]

    @property
    def detail(self) -> Float[np.ndarray, "n 3"]:
        """Factor on the diffuse reflectance of each observation's material."""
        return np.ones((len(self.block), 3)) if self.block.detail is None else self.block.detail

    def predict(self) -> Prediction:
        """Return the predicted radiance and its components."""
        block = self.block
        responses = []
        # D w, S w and (∂S/∂roughness) w, material by material
        diffuse, specular, by_roughness = np.zeros((3, len(block), 3))
        roughness = self.materials.roughness.tolist()
        if self.table is None:
            lobes = self.light.unit_lobes
            for m, rows in material_slices(block):
                diffuse[rows] = diffuse_response(block, rows, lobes, self.operator) @ self.light.weight
                specular[rows] = specular_response(block, rows, lobes, roughness[m], self.operator) @ self.light.weight
        else:
            for m in np.unique(block.material).tolist():
                rows = self.table.rows(m)
                lookup = self.table.interpolate(m, roughness[m])
                diffuse[rows], specular[rows], by_roughness[rows] = lookup.radiance(self.light.weight)
                responses.append((m, rows, lookup))
        diffuse, specular, by_roughness = (part * self.exposure for part in (diffuse, specular, by_roughness))
        diffuse = diffuse * self.detail
        if block.bounced is not None:
            diffuse = diffuse + block.bounced[:, :3]
            specular = specular + block.bounced[:, 3:]
        # ℓ and y
        linear = self.materials.diffuse[block.material] * diffuse + self.materials.specular[block.material] * specular
        radiance = self.light.apply_tone(linear, block.photo) + self.turned
        return Prediction(diffuse, specular, by_roughness, linear, radiance, responses)

    def radiance(self) -> Float[np.ndarray, "n 3"]:
        """Return y, the predicted radiance of every observation."""
        return self.predict().radiance

    def residuals(self) -> Float[np.ndarray, "n 3"]:
        """Return the residuals r of all observations, in σ of the noise model."""
        return self.block.residuals(self.radiance())

    def by_normal(self) -> Float[np.ndarray, "n 3 3"]:
        """Return ∂r/∂n of each observation, channel by axis, in the tangent plane of its normal."""
        block = self.block
        lit = np.zeros((len(block), 3))
        slopes = np.zeros((len(block), 3, 3))
        for m, rows in material_slices(block):
            lit[rows], slopes[rows] = self._linear_by_normal(m, rows)
        radiance = self.light.apply_tone(lit + self.bounced, block.photo)
        # ∂r/∂ℓ; a satisfied bound has no residual
        rising = block.inverse_sigma * self.light.tone_slope(radiance, block.photo)
        rising = np.where(block.clipped & (radiance >= block.radiance), 0.0, rising)
        return rising[:, :, None] * slopes

    def _linear_by_normal(self, m: int, rows: slice) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
        """Return the part of ℓ that the light sends, and ∂ℓ/∂n, of the observations `rows`, of material m."""
        block = self.block.take(np.arange(len(self.block))[rows])
        every = slice(len(block))
        lobes = self.light.unit_lobes
        normal = block.normal
        roughness = float(self.materials.roughness[m])
        nz, oz, larger = lobe_cosines(block, every, lobes)
        inputs = np.array(roughness), lobes.sharpness, (normal * block.view).sum(1), nz, oz
        unit = self.operator.response(*(torch.as_tensor(values).to(self.operator.dtype) for values in inputs))

        def reflect(normals: Float[np.ndarray, "n 3"], *responses: Tensor) -> Float[np.ndarray, "n 3"]:
            """Return the part of ℓ that the light sends, with the shadows of other normals."""
            turned = msgspec.structs.replace(block, normal=normals)
            kd, ks = self.materials.diffuse[m] * self.detail[rows], self.materials.specular[m]
            parts = zip((kd, ks), responses, (None, roughness), strict=True)
            return self.exposure[rows] * sum(
                k * ((larger * apply_shadows(part, turned, every, lobes, width).double().numpy()) @ self.light.weight)
                for k, part, width in parts
            )

        before = reflect(normal, unit.diffuse, unit.specular)
        tangent = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        result = np.zeros((len(normal), 3, 3))
        for along in (tangent, np.cross(normal, tangent)):
            # cosines are linear in n: the derivative of one along a tangent is the tangent's own
            cosines = lobe_cosines(msgspec.structs.replace(block, normal=along), every, lobes)[0]
            tz, to = map(torch.as_tensor, (cosines, (along * block.view).sum(1, keepdims=True)))
            diffuse = unit.diffuse + NORMAL_STEP * unit.diffuse_by_nz * tz
            specular = unit.specular + NORMAL_STEP * (unit.specular_by_nz * tz + unit.specular_by_no * to)
            slope = (reflect(normal + NORMAL_STEP * along, diffuse, specular) - before) / NORMAL_STEP
            result += slope[:, :, None] * along[:, None, :]
        return before, result

    def losses(self, loss: RobustLoss) -> Float[np.ndarray, " n"]:
        """Return the robust loss of every observation, averaged over its channels."""
        return loss.evaluate(self.residuals()).mean(1)

    def fitted_loss(self, residual: Float[np.ndarray, "n 3"], loss: RobustLoss) -> float:
        """Return Σ ρ(r), the robust loss summed over the fitted observations."""
        return float(loss.evaluate(residual)[~self.block.held_out].sum())

    def unit_responses(self, rows: Int[np.ndarray, " n"], lobes: UnitLobes) -> Float[np.ndarray, "3 n q"]:
        """Return the whitened response at `rows` to q further lobes of weight one, per channel."""
        block = self.block
        response = np.empty((2, len(rows), len(lobes)))
        for m in np.unique(block.material[rows]).tolist():
            selected = block.material[rows] == m
            response[0, selected] = diffuse_response(block, rows[selected], lobes, self.operator)
            response[1, selected] = specular_response(
                block, rows[selected], lobes, float(self.materials.roughness[m]), self.operator
            )
        # A = (k_d D + k_s S) e τ'/σ, linearised at the observed radiance
        slope = self.light.tone_slope(block.radiance[rows], block.photo[rows])
        scale = block.inverse_sigma[rows] * slope * self.exposure[rows]
        kd = self.materials.diffuse[block.material[rows]] * self.detail[rows]
        ks = self.materials.specular[block.material[rows]]
        return np.stack(
            [scale[:, c, None] * (kd[:, c, None] * response[0] + ks[:, c, None] * response[1]) for c in range(3)]
        )

    def root_weights(
        self, residual: Float[np.ndarray, "n 3"], loss: RobustLoss, temperature: float = 1.0
    ) -> Float[np.ndarray, "n 3"]:
        """Return the root of each residual's weight in the robust loss divided by T.

        It is 0 for held-out observations, and for clipped channels that are predicted bright enough.
        """
        counts = ~self.block.held_out[:, None] & ~(self.block.clipped & (residual >= 0))
        return np.sqrt(counts * loss.weights(residual) / temperature)

    def gradient(self, loss: RobustLoss, temperature: float) -> Gradient:
        """Return the robust loss Σ ρ(r)/T of the fitted observations and half its gradient, without a Jacobian.

        The cost is two products of the responses with three columns.
        """
        block = self.block
        light = self.light
        prediction = self.predict()
        residual = block.residuals(prediction.radiance)
        value = self.fitted_loss(residual, loss) / temperature
        # a = ½ ∂(Σ ρ/T)/∂ℓ; `lit` is the part of ℓ that is proportional to the light
        by_radiance = self.root_weights(residual, loss, temperature) ** 2 * residual * block.inverse_sigma
        by_linear = by_radiance * light.tone_slope(prediction.radiance - self.turned, block.photo)
        from_light = prediction.linear - self.bounced
        # Σ a ∂ℓ/∂(log k_d, log k_s, roughness), and Dᵀ a e k_d + Sᵀ a e k_s with respect to w
        by_materials = np.zeros((len(self.materials), UNKNOWNS))
        by_weight = np.zeros((len(light), 3))
        detail = self.detail
        for m, rows, lookup in prediction.responses:
            kd = self.materials.diffuse[m]
            ks = self.materials.specular[m]
            a = by_linear[rows]
            by_materials[m, :3] = kd * (a * prediction.diffuse[rows]).sum(0)
            by_materials[m, 3:6] = ks * (a * prediction.specular[rows]).sum(0)
            by_materials[m, 6] = float((ks * a * prediction.by_roughness[rows]).sum())
            lit = a * self.exposure[rows]
            by_weight += lookup.by_weight(lit * kd * detail[rows], lit * ks)
        # gradient by log radiance of free cells, turns, log exposures, log tone exponents and the log factor on fixed
        # cells
        by_cells = by_weight * light.weight
        parts = [by_cells[light.free].T.reshape(-1)]
        if block.by_turns is not None:
            parts.append(np.tensordot(by_radiance, block.by_turns))
        by_photo = np.bincount(block.photo, (by_linear * from_light).sum(1), len(light.log_exposure))
        parts.append(by_photo[len(by_photo) - light.free_exposures :])
        if len(light.log_tone):
            by_tone = by_radiance * by_log_exponent(np.maximum(prediction.linear, 0), light.exponents(block.photo))
            parts.append(np.bincount(block.photo, by_tone.sum(1), len(light.log_tone)))
        if light.scale_free:
            parts.append(by_cells[~light.free].sum(keepdims=True).reshape(1))
        return Gradient(value, by_materials, np.concatenate(parts))

    @property
    def turned(self) -> Float[np.ndarray, "n 3"] | float:
        """Change of the radiance y by turns of normals."""
        return 0.0 if self.block.by_turns is None else self.block.by_turns @ self.light.turns

    @property
    def bounced(self) -> Float[np.ndarray, "n 3"] | float:
        """Part of the linear radiance ℓ that other surfaces send."""
        block = self.block
        if block.bounced is None:
            return 0.0
        kd = self.materials.diffuse[block.material]
        ks = self.materials.specular[block.material]
        return kd * block.bounced[:, :3] + ks * block.bounced[:, 3:]

    def linearise(self, prediction: Prediction, loss: RobustLoss, temperature: float = 1.0) -> Iterator[Linearised]:
        """Yield residuals and derivatives, by material and channel.

        Held-out observations have weight 0.

        Args:
            prediction: Prediction of this illumination by its table.
            loss: Robust loss.
            temperature: T, which divides squared residuals.
        """
        light = self.light
        residual = self.block.residuals(prediction.radiance)
        pull = self.root_weights(residual, loss, temperature)
        scale = pull * self.block.inverse_sigma
        rising = scale * light.tone_slope(prediction.radiance - self.turned, self.block.photo)  # ∂r/∂ℓ
        by_photos = self._by_photos(prediction, scale, rising)
        free = light.free if light.fixed.any() else slice(None)
        detail = self.detail.astype(np.float32)
        for m, rows, lookup in prediction.responses:
            unit_specular = lookup.specular
            unit_slope = lookup.by_roughness
            for c in range(3):
                kd = np.float32(self.materials.diffuse[m, c])
                ks = np.float32(self.materials.specular[m, c])
                # ∂r/∂u = τ' e (k_d D + k_s S) w/σ, and its derivative by roughness
                bright = ((rising[rows, c] * self.exposure[rows, 0])[:, None] * light.weight[:, c]).astype(np.float32)
                by_roughness = unit_slope * (ks * bright)
                factors = ((kd, prediction.diffuse), (ks, prediction.specular), (ks, prediction.by_roughness))
                by_material = np.column_stack([k * values[rows, c] * rising[rows, c] for k, values in factors])
                diffuse = lookup.diffuse * (kd * detail[rows, c, None] * bright)
                specular = unit_specular * (ks * bright)
                by_photo = by_photos[c][rows]
                if light.scale_free:  # ∂r/∂ log of the factor on known cells
                    by_photo = np.hstack([by_photo, (diffuse + specular)[:, light.fixed].sum(1, keepdims=True)])
                yield Linearised(
                    c,
                    rows,
                    UNKNOWNS * m + np.array([c, 3 + c, REFLECTANCES]),
                    diffuse[:, free],
                    specular[:, free],
                    by_roughness[:, free],
                    by_material.astype(np.float32),
                    by_photo.astype(np.float32),
                    (residual * pull)[rows, c].astype(np.float32),
                )

    def _by_photos(
        self, prediction: Prediction, scale: Float[np.ndarray, "n 3"], rising: Float[np.ndarray, "n 3"]
    ) -> list[Float[np.ndarray, "n q"]]:
        """Return ∂r/∂η, ∂r/∂log e = τ' (ℓ − bounced)/σ and ∂r/∂log g of each channel.

        Args:
            prediction: Prediction of this illumination.
            scale: ∂r/∂y.
            rising: ∂r/∂ℓ.
        """
        light = self.light
        photos = np.eye(len(light.log_exposure))[self.block.photo]
        by_exposure = (prediction.linear - self.bounced) * rising
        free = photos[:, len(light.log_exposure) - light.free_exposures :]
        columns = [free * by_exposure[:, c, None] for c in range(3)]
        if self.block.by_turns is not None:
            by_turns = scale[:, :, None] * self.block.by_turns
            columns = [np.hstack([by_turns[:, c], column]) for c, column in enumerate(columns)]
        if len(light.log_tone):
            by_tone = scale * by_log_exponent(np.maximum(prediction.linear, 0), light.exponents(self.block.photo))
            columns = [np.hstack([column, photos * by_tone[:, c, None]]) for c, column in enumerate(columns)]
        return columns


def material_slices(block: Block) -> list[tuple[int, slice]]:
    """Split a block into runs of one material, at most CHUNK rows each; return (material, rows) of each."""
    starts = np.flatnonzero(np.diff(block.material, prepend=-1))
    ends = np.append(starts, len(block))[1:]
    return [
        (int(block.material[a]), slice(i, min(i + CHUNK, b)))
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True)
        for i in range(a, b, CHUNK)
    ]
