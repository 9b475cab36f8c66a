"""Suns: light that comes from one direction, where photographs allow it.

The sun's disc is half a degree wide and holds a fifth to two thirds of the light outdoors.  Cells share that energy out among all directions which
the observations cannot tell apart, ten degrees and more, and what is lit by such a light has no crisp shadow.  Direction and energy are known far
better than width, and natural light knows the width: so two lights are compared.  In both, cells within DISC of the brightest direction show what
surrounds them, and one lobe is added, as narrow as the sun or as WIDE as a window.  Its direction z and its weight w ≥ 0 are those of least

    Σ_i t_i² (r_i + A_i(z) w)²        channel by channel;  t² the trust of the robust loss,  A the whitened response                (1)

which is linear in w and searched over a grid of z, coarse and then fine.  The narrow lobe is kept where it explains the observations
no worse (by more than `FOR_SUN` standard errors), and sends at least `SHARE` of the light.  Cells are fitted once more around it.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.lobes import SUN
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light, UnitLobes
from factorlib.model.loss import Loss
from factorlib.solve.evidence import Evidence, Losses, compare
from factorlib.solve.fit import ROBUST

DISC, SURROUNDINGS = (
    np.radians(14),
    np.radians(28),
)  # about the brightest direction: what a sun replaces, and what is seen in its place
WIDE = 1 / np.radians(4) ** 2  # λ of a lobe of 8° between its inflections
BLUR = 1 / np.radians(5) ** 2  # λ: the brightest direction is that of the light so blurred
GRIDS = (
    (15.0, 3.0),
    (4.0, 0.8),
    (1.0, 0.2),
)  # degrees: radius and step of the searches, each about the best of the one before
FOR_SUN, SHARE = 0.0, 0.05


class Candidate(NamedTuple):
    """The light with one lobe in place of its brightest cells, and the robust losses of all observations."""

    light: Light
    losses: Float[np.ndarray, " n"]


def with_sun(illumination: Illumination) -> tuple[Light, Evidence]:
    """The light of an illumination with its sun, if it has one, and the evidence: `with` is the sun's narrow lobe, `without` the wide one."""
    light, block = illumination.light, illumination.block
    if light.suns.any() or not len(block):
        return light, Evidence(bool(light.suns.any()))
    overlap = np.exp(BLUR * (light.axis @ light.axis.T - 1))
    z = light.axis[int(np.argmax(overlap @ light.energy.sum(1)))]
    away = np.arccos(np.clip(light.axis @ z, -1, 1))
    u, ring = light.log_radiance, (away >= DISC) & (away < SURROUNDINGS)
    if not ring.any():  # cells are larger than that
        return light, Evidence(False)
    u[:, away < DISC] = np.median(u[:, ring], axis=1)[:, None]
    without = msgspec.structs.replace(illumination, light=light.with_log_radiance(u))
    trust = np.sqrt(ROBUST.trust(illumination.residuals()) * ~(block.clipped & (illumination.residuals() >= 0)))
    narrow, wide = (_candidate(without, z, sharpness, trust) for sharpness in (SUN, WIDE))
    number = block.clusters()
    evidence = compare(Losses([wide.losses], [number]), Losses([narrow.losses], [number]), FOR_SUN)
    share = narrow.light.energy[-1].sum() / narrow.light.energy.sum()
    kept = evidence.kept and bool(share >= SHARE)
    return narrow.light if kept else light, msgspec.structs.replace(evidence, kept=kept)


def _candidate(
    without: Illumination, z: Float[np.ndarray, "3"], sharpness: float, trust: Float[np.ndarray, "n 3"]
) -> Candidate:
    """Equation (1) minimised, for a lobe of that sharpness near z."""
    rows, residual = np.arange(len(without.block)), without.residuals()
    for radius, step in GRIDS:
        grid = UnitLobes(axes := _near(z, radius, step), np.full(len(axes), sharpness))
        A = without.atoms(rows, grid) * trust.T[:, :, None]  # [3, n, q]
        along, size = np.einsum("cnq,nc->cq", A, trust * residual), np.einsum("cnq,cnq->cq", A, A)
        weight = np.maximum(-along, 0) / np.maximum(size, 1e-30)
        best = int(np.argmax((weight**2 * size).sum(0)))  # by how much (1) falls
        z, w = axes[best], weight[:, best]
    light = without.light.with_lobe(z, sharpness, w)
    return Candidate(light, msgspec.structs.replace(without, light=light).losses(Loss()))


def _near(z: Float[np.ndarray, "3"], radius: float, step: float) -> Float[np.ndarray, "q 3"]:
    """The directions of a lattice of spacing `step` that are at most `radius` from z; degrees."""
    lattice = fibonacci_sphere(round(4 * np.pi / np.radians(step) ** 2))
    return lattice[lattice @ z >= np.cos(np.radians(radius))]
