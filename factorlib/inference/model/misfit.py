"""Share of the shading that an answer leaves unexplained, and share of clipped values, by photo and for the whole set.

Noise varies from pixel to pixel.  Errors of a wrong mesh, mask, label or tone curve are correlated among neighbours.  A
group g holds the n_g observations of one material in one photo that mirror one region of the light, with reliable
normals and nothing clipped.  Values x are relative to the mean radiance of the material in the photo.  Their energy
without independent noise, over all channels, is

    E(x) = Σ_g n_g max(mean_g(x)² − s_g²(x)/n_g, 0),     s_g² the variance in the group                              (1)

The unexplained share is E(r) / E(v), with r the residual of the answer and v the radiance minus its mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.geometry.sphere import mirror_cells
from factorlib.inference.model.blocks import Block
from factorlib.inference.model.problem import JointProblem
from factorlib.results.materials import Misfit

REGION = 0.3  # side of the cells of mirror directions, about 17°
LEAST_CONFIDENCE = 0.3  # least confidence of a normal, exclusive
LEAST_GROUP = 4  # least number of observations in a group
LARGEST_SHARE = 3.0  # upper limit of an unexplained share


def unexplained_shares(
    problem: JointProblem, radiance: Sequence[Float[np.ndarray, "n 3"]]
) -> tuple[float, dict[str, Misfit]]:
    """Return the unexplained share of the whole set, and unexplained and clipped shares by photo."""
    energies = {}
    clipped = {}
    for block, predicted in zip(problem.blocks, radiance, strict=True):
        for number, photo in enumerate(block.photos):
            photo_mask = block.photo == number
            energies[photo] = np.sum(list(_energies(block, predicted, photo_mask)) or [(0.0, 0.0)], axis=0)
            clipped[photo] = float(block.clipped[photo_mask].mean()) if photo_mask.any() else 0.0
    by_photo = {photo: Misfit(_share(*energy), clipped[photo]) for photo, energy in energies.items()}
    return _share(*np.sum(list(energies.values()), axis=0)), by_photo


def _energies(
    block: Block, predicted: Float[np.ndarray, "n 3"], photo_mask: Bool[np.ndarray, " n"]
) -> Iterator[tuple[float, float]]:
    """Yield E(r) and E(v) of each material in a photo."""
    reliable = (
        photo_mask & ~block.clipped.any(1) & (True if block.confidence is None else block.confidence > LEAST_CONFIDENCE)
    )
    for material in np.unique(block.material[reliable]):
        rows = reliable & (block.material == material)
        mean = np.maximum(block.radiance[rows].mean(0), 1e-12)
        group = np.unique(mirror_cells(block.normal[rows], block.view[rows], REGION), return_inverse=True)[1].reshape(
            -1
        )
        residual = (block.radiance[rows] - predicted[rows]) / mean
        variation = block.radiance[rows] / mean - 1
        yield correlated_energy(residual, group), correlated_energy(variation, group)


def correlated_energy(values: Float[np.ndarray, "n 3"], group: Int[np.ndarray, " n"]) -> float:
    """Return the correlated energy E of (1); groups of fewer than `LEAST_GROUP` observations are left out.

    >>> alike, noise = np.full((8, 3), 0.1), np.tile([[0.1], [-0.1]], (4, 3))
    >>> round(correlated_energy(alike, np.zeros(8, int)), 9), correlated_energy(noise, np.zeros(8, int))
    (0.24, 0.0)
    """
    count = np.bincount(group).astype(float)
    total = 0.0
    for channel in values.T:
        # mean and s² of each group, then n max(mean² − s²/n, 0)
        mean = np.bincount(group, channel) / count
        variance = np.bincount(group, (channel - mean[group]) ** 2) / np.maximum(count - 1, 1)
        total += float(np.sum((count * np.maximum(mean**2 - variance / count, 0))[count >= LEAST_GROUP]))
    return total


def _share(unexplained: float, total: float) -> float:
    """Return the ratio of two energies, at most `LARGEST_SHARE`, rounded to nine digits."""
    return round(float(min(unexplained / max(total, 1e-12), LARGEST_SHARE)), 9) if unexplained > 0 else 0.0
