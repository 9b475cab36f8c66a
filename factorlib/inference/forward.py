"""One illumination of the joint problem at a point: what its photos show, what the model says they should, and all derivatives.

    linear     ℓ_ic = k_d,c (e_i Σ_p D_ip w_pc + G_d,ic) + k_s,c (e_i Σ_p S_ip w_pc + G_s,ic),       w_p = peak_p exp(u_p)
    predicted  y_ic = τ_i(ℓ_ic), τ the photo's tone curve
    residual   r_ic = (y_ic − radiance_ic) / σ_ic; where the channel is clipped min(r_ic, 0), for the true radiance may be higher

D and S are the responses of `factorlib.inference.responses`, e is the photo's exposure, G what other surfaces send
(`factorlib.inference.interreflection`).  A new physical effect is added here once: radiance and derivatives are of one
and the same sum.

Unknowns: log k_d, log k_s (RGB each) and roughness of a material; u of every cell and channel; log exposures and log tone exponents.  A
channel's residuals depend on the cells of that channel alone, so the Jacobian is a dense block a channel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.images.tone import by_log_exponent
from factorlib.inference.blocks import Block
from factorlib.inference.lights import Light, UnitLobes
from factorlib.inference.materials import Materials
from factorlib.inference.noise import Loss
from factorlib.inference.responses import CHUNK, Reflected, Table, diffuse_response, specular_response
from factorlib.reflection.operator import Operator


class Shown(NamedTuple):
    """The model says that n observations should show this.

    diffuse, specular   the factors of k_d and k_s in ℓ;  by_roughness  ∂specular/∂roughness;  radiance  y
    responses           material, its rows, its responses; empty where the operator itself was asked
    """

    diffuse: Float[np.ndarray, "n 3"]
    specular: Float[np.ndarray, "n 3"]
    by_roughness: Float[np.ndarray, "n 3"]
    linear: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    responses: list[tuple[int, slice, Reflected]]


class Linearised(NamedTuple):
    """One channel of the observations of one material, whitened, weighted by the robust loss and divided by √T; float32.

    diffuse, specular   the two parts of ∂r/∂u of the channel's free cells;  by_roughness  ∂²r/∂u ∂roughness
    by_material         ∂r by log k_d, log k_s and roughness, the unknowns `places` of the materials
    by_photo            ∂r by the log exposures of all photos but the first, unless they are held, by the log tone exponents, and by the
                        log of the factor on held cells, where it is free
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
    """A value, and half its gradient by log k_d, log k_s and roughness of every material, and by the unknowns of a light."""

    value: float
    by_materials: Float[np.ndarray, "m 7"]
    by_light: Float[np.ndarray, " l"]


class Illumination(msgspec.Struct, frozen=True):
    """The observations in one light, that light, the materials and the reflection operator; radiance is in the block's unit.

    table: the responses of this block to the lobes of this light; None: the operator itself is asked
    """

    block: Block
    light: Light
    materials: Materials
    operator: Operator
    table: Table | None = None

    @property
    def exposure(self) -> Float[np.ndarray, "n 1"]:
        """Return the exposure of each observation's photo: a factor on the light."""
        return np.exp(self.light.log_exposure)[self.block.photo][:, None]

    def fitted(self) -> Illumination:
        """Return the illumination with the observations alone that are not held out."""
        return msgspec.structs.replace(self, block=self.block.fitted())

    def shown(self) -> Shown:
        """Radiance, and what it is made of."""
        block = self.block
        kd = self.materials.diffuse
        ks = self.materials.specular
        responses = []
        diffuse, specular, by_roughness = np.zeros((3, len(block), 3))
        weight = self.light.weight
        roughness = self.materials.roughness.tolist()
        if self.table is None:
            lobes = self.light.unit_lobes
            for m, rows in material_slices(block):
                diffuse[rows] = diffuse_response(block, rows, lobes, self.operator) @ weight
                specular[rows] = specular_response(block, rows, lobes, roughness[m], self.operator) @ weight
        else:
            for m in np.unique(block.material).tolist():
                rows = self.table.rows(m)
                of = self.table.at(m, roughness[m])
                diffuse[rows], specular[rows], by_roughness[rows] = of.radiance(weight)
                responses.append((m, rows, of))
        diffuse, specular, by_roughness = (part * self.exposure for part in (diffuse, specular, by_roughness))
        if block.bounced is not None:
            diffuse = diffuse + block.bounced[:, :3]
            specular = specular + block.bounced[:, 3:]
        linear = kd[block.material] * diffuse + ks[block.material] * specular
        toned = self.light.toned(linear, block.photo)
        return Shown(diffuse, specular, by_roughness, linear, toned, responses)

    def radiance(self) -> Float[np.ndarray, "n 3"]:
        """y: what every observation should show."""
        return self.shown().radiance

    def residuals(self) -> Float[np.ndarray, "n 3"]:
        """r, in σ of the noise model."""
        return self.block.residuals(self.radiance())

    def losses(self, loss: Loss) -> Float[np.ndarray, " n"]:
        """Robust loss of every observation, mean over its channels."""
        return loss.of_residuals(self.residuals()).mean(1)

    def atoms(self, rows: Int[np.ndarray, " n"], lobes: UnitLobes) -> Float[np.ndarray, "3 n q"]:
        """What q further lobes of weight one would add to the whitened residuals at `rows`, per channel."""
        block = self.block
        materials = self.materials
        response = np.empty((2, len(rows), len(lobes)))
        for m in np.unique(block.material[rows]).tolist():
            of = block.material[rows] == m
            response[0, of] = diffuse_response(block, rows[of], lobes, self.operator)
            response[1, of] = specular_response(block, rows[of], lobes, float(materials.roughness[m]), self.operator)
        slope = self.light.slope_at(block.radiance[rows], block.photo[rows])
        scale = block.precision[rows] * slope * self.exposure[rows]
        kd = materials.diffuse[block.material[rows]]
        ks = materials.specular[block.material[rows]]
        return np.stack(
            [scale[:, c, None] * (kd[:, c, None] * response[0] + ks[:, c, None] * response[1]) for c in range(3)]
        )

    def pull(
        self, residual: Float[np.ndarray, "n 3"], loss: Loss, temperature: float = 1.0
    ) -> Float[np.ndarray, "n 3"]:
        """The root of how much each residual counts; 0 for one that is held out, and for a clipped one that is bright enough."""
        counts = ~self.block.held_out[:, None] & ~(self.block.clipped & (residual >= 0))
        return np.sqrt(counts * loss.trust(residual) / temperature)

    def gradient(self, loss: Loss, temperature: float) -> Gradient:
        """Σ ρ(r)/T of the observations that are not held out, and half its gradient by all unknowns, without a Jacobian.

        It costs two products of the responses with three columns.
        """
        block = self.block
        light = self.light
        materials = self.materials
        shown = self.shown()
        residual = block.residuals(shown.radiance)
        value = float(loss.of_residuals(residual)[~block.held_out].sum()) / temperature
        # a = ½ ∂(Σ ρ/T)/∂ℓ;  what of ℓ grows with the light
        by_radiance = self.pull(residual, loss, temperature) ** 2 * residual * block.precision
        by_linear = by_radiance * light.slope_at(shown.radiance, block.photo)
        lit = shown.linear - self.bounced
        by_materials = np.zeros((len(materials), 7))
        by_weight = np.zeros((len(light), 3))
        for m, rows, of in shown.responses:
            kd = materials.diffuse[m]
            ks = materials.specular[m]
            a = by_linear[rows]
            by_materials[m, :3] = kd * (a * shown.diffuse[rows]).sum(0)
            by_materials[m, 3:6] = ks * (a * shown.specular[rows]).sum(0)
            by_materials[m, 6] = float((ks * a * shown.by_roughness[rows]).sum())
            by_weight += of.by_weight(a * self.exposure[rows] * kd, a * self.exposure[rows] * ks)
        # by log radiance of free cells, log exposures, log tone exponents, and the log of the factor on held cells
        by_cells = by_weight * light.weight
        by_photo = np.bincount(block.photo, (by_linear * lit).sum(1), len(light.log_exposure))
        parts = [by_cells[light.free].T.reshape(-1), by_photo[len(by_photo) - light.free_exposures :]]
        if len(light.log_tone):
            by_tone = by_radiance * by_log_exponent(np.maximum(shown.linear, 0), light.exponents(block.photo))
            parts.append(np.bincount(block.photo, by_tone.sum(1), len(light.log_tone)))
        if light.scale_free:
            parts.append(by_cells[~light.free].sum(keepdims=True).reshape(1))
        return Gradient(value, by_materials, np.concatenate(parts))

    @property
    def bounced(self) -> Float[np.ndarray, "n 3"] | float:
        """What of ℓ other surfaces send."""
        block = self.block
        materials = self.materials
        if block.bounced is None:
            return 0.0
        kd = materials.diffuse[block.material]
        ks = materials.specular[block.material]
        return kd * block.bounced[:, :3] + ks * block.bounced[:, 3:]

    def linearise(self, shown: Shown, loss: Loss, temperature: float = 1.0) -> Iterator[Linearised]:
        """Residuals and derivatives; `shown` is what this illumination shows by its table.  Held-out observations have weight 0."""
        block = self.block
        light = self.light
        materials = self.materials
        residual = block.residuals(shown.radiance)
        pull = self.pull(residual, loss, temperature)
        scale = pull * block.precision
        rising = scale * light.slope_at(shown.radiance, block.photo)  # ∂r/∂ℓ
        lit = shown.linear - self.bounced
        if toned := len(light.log_tone) > 0:
            by_tone = scale * by_log_exponent(np.maximum(shown.linear, 0), light.exponents(block.photo))
        photos = np.eye(len(light.log_exposure))[block.photo]
        free = light.free if light.held.any() else slice(None)
        first = len(light.log_exposure) - light.free_exposures
        for m, rows, of in shown.responses:
            of_specular = of.specular
            of_roughness = of.by_roughness
            for c in range(3):
                kd = np.float32(materials.diffuse[m, c])
                ks = np.float32(materials.specular[m, c])
                bright = ((rising[rows, c] * self.exposure[rows, 0])[:, None] * light.weight[:, c]).astype(np.float32)
                by_roughness = of_roughness * (ks * bright)
                own = [kd * shown.diffuse[rows, c] * rising[rows, c], ks * shown.specular[rows, c] * rising[rows, c]]
                diffuse = of.diffuse * (kd * bright)
                specular = of_specular * (ks * bright)
                by_photo = photos[rows, first:] * (lit[rows, c] * rising[rows, c])[:, None]
                if toned:
                    by_photo = np.hstack([by_photo, photos[rows] * by_tone[rows, c, None]])
                if light.scale_free:
                    by_photo = np.hstack([by_photo, (diffuse + specular)[:, light.held].sum(1, keepdims=True)])
                yield Linearised(
                    c,
                    rows,
                    7 * m + np.array([c, 3 + c, 6]),
                    diffuse[:, free],
                    specular[:, free],
                    by_roughness[:, free],
                    np.column_stack([*own, ks * shown.by_roughness[rows, c] * rising[rows, c]]).astype(np.float32),
                    by_photo.astype(np.float32),
                    (residual * pull)[rows, c].astype(np.float32),
                )


def material_slices(block: Block) -> list[tuple[int, slice]]:
    """(material, rows) of runs of one material, of at most CHUNK rows."""
    starts = np.flatnonzero(np.diff(block.material, prepend=-1))
    ends = np.append(starts, len(block))[1:]
    return [
        (int(block.material[a]), slice(i, min(i + CHUNK, b)))
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True)
        for i in range(a, b, CHUNK)
    ]
