"""New lobes where the residual is large: matching pursuit over a dictionary of axes and sharpnesses.

Light is a non-negative measure on the sphere.  If one lobe is added with its best non-negative weights, the squared residual falls
most for

    argmax_j  Σ_c max(⟨a_jc, r_c⟩, 0)² / ‖a_jc‖²,      a_jc the whitened response of lobe j in channel c,

Its contribution is then taken out of the residual, and the next lobe is looked for: the insertion step of sliding Frank–Wolfe.  The
joint descent that follows moves the lobes away from the directions and sharpnesses of the dictionary.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light, UnitLobes

DICTIONARY = {1.0: 32, 6.0: 96, 30.0: 300, 150.0: 600, 700.0: 1200}  # sharpness -> number of axes
SAMPLE = 700  # observations whose residuals choose the lobes
TOO_NEAR = 0.7  # least distance of two lobes of a round, in their widths


def dictionary(sharpest: float = np.inf) -> UnitLobes:
    """The lobes to choose from: those no sharper than `sharpest`, and the widest in any case."""
    axes = [fibonacci_sphere(count) for count in DICTIONARY.values()]
    axis, sharpness = np.vstack(axes), np.repeat(list(DICTIONARY), list(DICTIONARY.values()))
    resolved = sharpness <= max(sharpest, sharpness.min())
    return UnitLobes(axis[resolved], sharpness[resolved])


class Candidates(msgspec.Struct, frozen=True):
    """The dictionary's lobes, and their whitened responses at the rows of observations that vote; of use as long as materials stay."""

    rows: Int[np.ndarray, " n"]
    lobes: UnitLobes
    atoms: Float[np.ndarray, "3 n j"]


def candidates(illumination: Illumination, seed: int, sample: int = SAMPLE) -> Candidates:
    """Return candidates at `sample` of the observations, or all of fewer, drawn by `seed`."""
    rows, lobes = np.flatnonzero(~illumination.block.held_out), dictionary(illumination.materials.sharpest)
    if len(rows) > sample:
        rows = np.sort(np.random.default_rng(seed).choice(rows, sample, replace=False))
    return Candidates(rows, lobes, illumination.atoms(rows, lobes))


def lobes_inserted(illumination: Illumination, count: int, candidates: Candidates) -> Light:
    """The light with up to `count` further lobes that explain what it leaves unexplained."""
    residual, atoms = -illumination.residuals()[candidates.rows], candidates.atoms
    axis, sharpness = candidates.lobes.axis, candidates.lobes.sharpness
    norm = np.maximum(np.sum(atoms**2, axis=1), 1e-12)  # [3, j]
    correlation = np.einsum("cnj,nc->cj", atoms, residual)
    allowed = norm.sum(0) > 1e-6 * norm.sum(0).max()
    chosen, weights = [], []
    for _ in range(count):
        gain = np.where(allowed, (np.maximum(correlation, 0) ** 2 / norm).sum(0), 0.0)
        best = int(gain.argmax())
        if gain[best] <= 1e-9 * max(float(np.sum(residual**2)), 1e-30):
            break
        weight = np.maximum(correlation[:, best], 0) / norm[:, best]
        correlation -= np.einsum("cnj,cn->cj", atoms, atoms[:, :, best] * weight[:, None])
        chosen.append(best)
        weights.append(weight)
        width = TOO_NEAR * np.sqrt(2 / np.minimum(sharpness, sharpness[best]))
        apart = np.linalg.norm(axis - axis[best], axis=1)
        allowed &= (apart > width) | (np.abs(np.log(sharpness / sharpness[best])) > 1)
    return illumination.light.with_lobes(UnitLobes(axis[chosen], sharpness[chosen]), np.array(weights).reshape(-1, 3))
