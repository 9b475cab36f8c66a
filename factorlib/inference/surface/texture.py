"""Albedo texture: a factor per channel on a material's diffuse reflectance, at the nodes of a subdivided mesh.

Lights, the specular part and the surface are given.  Pixel i then shows

    y_i = k_d t_i D_i + S_i,      t_i = Σ_k b_ik f_{v_ik}                                                            (1)

with D the diffuse radiance for k_d = 1 and S the specular radiance, both with shadows and interreflection.  f_v is the
factor at node v, and b are barycentric coordinates.  So z_i = (y_i − S_i)/(k_d D_i) observes t_i, and f minimises

    Σ_i w_i ρ(z_i − t_i) + a Σ_edges |f_v − f_w|² + ε Σ_v |f_v − 1|²                                                 (2)

with ρ the pseudo-Huber loss, by reweighted least squares.  Errors of D are relative to it, and those of y are not: a
channel has the weight x²/(x² + d²), x = k_d D and d the share `DARK` of the mean of k_d D + S over the material's
pixels in the photo.  w is the largest of the three weights, times the cosine.  A metal thus observes no paint.  A
channel too dark to observe paint follows the others: its z is its own by the share x⁴/(x⁴ + d⁴), and for the rest the
weighted mean of all channels.  Nodes that no pixel shows continue the ones around them.

Evidence    Each photo is predicted by the texture of others, a fold of photos at a time, where these see its surface.
            The stiffness a with the least loss is used.  The texture is kept if it predicts better than the best flat
            colour of the others (`factorlib.inference.choices.model_selection`).  A part in one photo alone gives no
            evidence: its texture would only repeat that photo.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, diags_array, eye_array

from factorlib.inference.choices.model_selection import CLEARLY_FOR, Losses, compare_models, gains
from factorlib.inference.model.blocks import RobustLoss
from factorlib.meshes.subdivision import solve_by_gradients
from factorlib.results.materials import Decision

STIFFNESSES = (3.0, 1.0, 0.3, 0.1, 0.03)  # a of (2), from stiff to soft
PULL = 1e-4  # ε of (2), which only fixes meshes that no pixel shows
DARK = 0.2  # d, as a share of the material's mean radiance in a photo
LOSS = RobustLoss(0.15)  # ρ of (2)
REWEIGHTINGS = 2  # solutions of (2) after the first one
# Least relative gain of the loss over the flat colour's, and a loss added to both: that of paint of 4.5 %.
# Under two standard errors alone, plain shells of a painted set got textures of their wrong normals.
LEAST_GAIN = 0.2
INVISIBLE = 0.002
LARGEST_RATIO = 20.0  # largest z
LEAST_SHARED = 0.2  # least weight of other photos' pixels about a node that counts as seen by them
CG_TOLERANCE = 1e-3
FOLDS = 4  # folds of photos


class TextureSamples(msgspec.Struct, frozen=True):
    """Pixels of one photo that observe a texture.

    Attributes:
        operator: b of (1).
        ratio: z.
        weight: w of (2).
        cluster: Number of each pixel's cluster; residuals of one are correlated.
    """

    operator: csr_array  # [n, v]
    ratio: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, " n"]
    cluster: Int[np.ndarray, " n"]

    def losses(self, factor: Float[np.ndarray, "n 3"], rows: np.ndarray) -> Float[np.ndarray, " n"]:
        """Return the weighted robust loss of the pixels `rows` for the factors at all pixels."""
        return (self.weight * LOSS.evaluate(self.ratio - factor).mean(1))[rows]


def observe_texture(
    radiance: Float[np.ndarray, "n 3"],
    diffuse: Float[np.ndarray, "n 3"],
    specular: Float[np.ndarray, "n 3"],
    cosine: Float[np.ndarray, " n"],
    positions: tuple[csr_array, Int[np.ndarray, " n"]],
) -> TextureSamples:
    """Return the samples of pixels with linear radiance y, of which k_d D and S are predicted.

    Args:
        radiance: y.
        diffuse: k_d D.
        specular: S.
        cosine: Cosine between normal and view.
        positions: b of (1), and the cluster of each pixel.
    """
    dark = DARK * max(float((diffuse + specular).mean()), 1e-12) if len(diffuse) else 1.0
    weight = diffuse**2 / (diffuse**2 + dark**2)
    ratio = ((radiance - specular) / np.maximum(diffuse, 1e-3 * dark)).clip(0, LARGEST_RATIO)
    # z̄, which channels too dark to observe paint follow
    mean = (weight * ratio).sum(1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    own = diffuse**4 / (diffuse**4 + dark**4)
    ratio = own * ratio + (1 - own) * mean
    return TextureSamples(positions[0], ratio, cosine * weight.max(1), positions[1])


def solve_texture(
    samples: Sequence[TextureSamples],
    laplacian: csr_array,
    stiffness: float,
    start: Float[np.ndarray, "v 3"] | None = None,
) -> Float[np.ndarray, "v 3"]:
    """Return the factors at all nodes that minimise (2).

    Args:
        samples: Pixels of each photo.
        laplacian: Laplacian of the mesh.
        stiffness: a of (2).
        start: Factors of another solution, from which the search begins.
    """
    prior = csr_array(stiffness * laplacian + PULL * eye_array(laplacian.shape[0]))
    factor = np.ones((laplacian.shape[0], 3)) if start is None else start.copy()
    weights = [sample.weight for sample in samples]
    if start is not None:
        weights = [s.weight * LOSS.weights(s.ratio - s.operator @ factor).mean(1) for s in samples]
    for _ in range(1 + REWEIGHTINGS):
        system = prior.copy()
        target = np.full(factor.shape, PULL)
        for sample, weight in zip(samples, weights, strict=True):
            weighted = csr_array(sample.operator.T @ diags_array(weight))
            system = csr_array(system + weighted @ sample.operator)
            target += weighted @ sample.ratio
        diagonal = system.diagonal()
        for c in range(3):
            factor[:, c] = solve_by_gradients(system, target[:, c], diagonal, CG_TOLERANCE, factor[:, c])
        weights = [s.weight * LOSS.weights(s.ratio - s.operator @ factor).mean(1) for s in samples]
    return factor


def select_texture(
    samples: Sequence[TextureSamples], laplacian: csr_array, stiffnesses: Sequence[float] = STIFFNESSES
) -> tuple[Float[np.ndarray, "v 3"] | None, Decision, float]:
    """Return the texture if photos are predicted better by it, with the evidence and the stiffness.

    Args:
        samples: Pixels of each photo.
        laplacian: Laplacian of the mesh.
        stiffnesses: Candidates for the stiffness, from stiff to soft.
    """
    folds = min(FOLDS, len(samples))
    seen = np.array([sample.operator.T @ sample.weight for sample in samples])
    # pixels of each photo that photos of other folds see as well
    shared = []
    for k, sample in enumerate(samples):
        elsewhere = seen.sum(0) - seen[k % folds :: folds].sum(0)
        shared.append(np.flatnonzero((sample.operator @ elsewhere > LEAST_SHARED) & (sample.weight > 0)))
    predicted = [k for k, rows in enumerate(shared) if len(rows)]
    if len(samples) < 2 or not predicted:
        return None, Decision(False), stiffnesses[0]
    clusters = [np.unique(samples[k].cluster[shared[k]], return_inverse=True)[1] for k in predicted]
    others = [[sample for number, sample in enumerate(samples) if number % folds != fold] for fold in range(folds)]
    colours = [flat_colour(other) for other in others]
    flat = Losses([samples[k].losses(colours[k % folds], shared[k]) for k in predicted], clusters)
    best: tuple[Decision, float] | None = None
    textures = [np.tile(colour, (laplacian.shape[0], 1)) for colour in colours]
    for stiffness in stiffnesses:
        pairs = zip(others, textures, strict=True)
        textures = [solve_texture(other, laplacian, stiffness, texture) for other, texture in pairs]
        losses = [samples[k].losses(samples[k].operator @ textures[k % folds], shared[k]) for k in predicted]
        evidence = compare_models(flat, Losses(losses, clusters), CLEARLY_FOR)
        evidence = msgspec.structs.replace(
            evidence, accepted=evidence.accepted and gains(evidence, LEAST_GAIN, INVISIBLE)
        )
        if best is not None and (evidence.held_out_loss_with or 0) >= (best[0].held_out_loss_with or 0):
            break
        best = evidence, stiffness
    assert best is not None
    texture = solve_texture(samples, laplacian, best[1]) if best[0].accepted else None
    return texture, best[0], best[1]


def flat_colour(samples: Sequence[TextureSamples]) -> Float[np.ndarray, "1 3"]:
    """Return the factor of the best flat colour, the robust mean of the ratios of all pixels."""
    ratio = np.vstack([sample.ratio for sample in samples])
    weight = np.concatenate([sample.weight for sample in samples])
    factor = np.ones((1, 3))
    weights = np.repeat(weight[:, None], 3, axis=1)
    for _ in range(1 + REWEIGHTINGS):
        factor = ((weights * ratio).sum(0) / np.maximum(weights.sum(0), 1e-12))[None]
        weights = weight[:, None] * LOSS.weights(ratio - factor)
    return factor
