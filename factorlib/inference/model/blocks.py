"""Observations under one illumination, in that illumination's frame and radiance unit; their noise model and loss."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from factorlib.geometry.sphere import mirror_cells
from factorlib.inference.model.background import Background

PER_OBSERVATION = (
    *("normal", "view", "radiance", "clipped", "inverse_sigma", "material", "photo", "held_out"),
    *("visibility", "bounced", "confidence", "place", "row", "object"),
    *("detail", "given_normal", "by_turns"),  # optional columns
)
LEAST_CONFIDENCE = 0.05  # of a normal: a smaller one counts as this
CLUSTER = 0.35  # side of a cluster's cell of mirror directions: 20°


class Noise(msgspec.Struct, frozen=True):
    """Noise model σ² = absolute² + (relative · radiance)², in units of a block's mean radiance.

    The relative part covers errors that grow with brightness: of a photo's tone curve, of normals, and of too coarse
    cells.

    Attributes:
        absolute: σ in the dark.
        relative: Part of σ that is proportional to radiance, per radiance.
        most_weight: Limit of the number of independent observations that a merged one counts for.
    """

    absolute: float = 0.05
    relative: float = 0.05
    most_weight: float = 8.0

    def sigma(self, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the standard deviation σ of a pixel's radiance."""
        return np.sqrt(self.absolute**2 + (self.relative * radiance) ** 2)

    def inverse_sigma(
        self, radiance: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return √weight/σ of observations, with their weights limited."""
        # smooth limit of the weight
        limited = weight / (1 + weight / self.most_weight)
        return np.sqrt(limited)[:, None] / self.sigma(radiance)


class RobustLoss(msgspec.Struct, frozen=True):
    """Pseudo-Huber loss, Σ 2k² (√(1 + r²/k²) − 1) of whitened residuals r.

    It bounds the influence of wrong normals and mask borders.

    Attributes:
        robust_scale: k, in σ.
    """

    robust_scale: float

    def evaluate(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the loss of each whitened residual."""
        return 2 * self.robust_scale**2 * (np.sqrt(1 + (residual / self.robust_scale) ** 2) - 1)

    def weights(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return weights in ]0, 1] of the squared residuals, for least-squares steps of this loss."""
        return 1 / np.sqrt(1 + (residual / self.robust_scale) ** 2)


# In a fit, residuals beyond 3 σ of the noise model are outliers.  Comparisons of models have a wider limit, because a
# model that lacks a highlight has such residuals.
FIT_LOSS = RobustLoss(3.0)
COMPARISON_LOSS = RobustLoss(10.0)


class Block(msgspec.Struct, frozen=True):
    """The n observations under one illumination, sorted by material.

    Attributes:
        name: Name of the illumination.
        photos: Names of its f photos.
        unit: Mean radiance of the block; `radiance` is divided by it.
        normal: Unit normals, in the illumination's frame.
        view: Unit vectors toward the camera, in the illumination's frame.
        radiance: Observed linear radiance, in `unit`.
        clipped: Mask of the channels whose radiance is a lower bound.
        inverse_sigma: 1/σ of the noise model times the root of the observation's weight; 0 for a channel without
            information.
        material: Number of each observation's material.
        photo: Number of each observation's photo in `photos`.
        held_out: Mask of the observations that select models and are not fitted.
        visibility: Visible share of each of k directions, 0 (hidden) to 255 (visible); None if nothing is hidden.
        directions: The k directions of `visibility`, in the block's frame, for each of the f photos.
        bounced: Radiance that hidden directions send, weighted by the cosine (RGB) and by a highlight (RGB): G_d and
            G_s of `factorlib.inference.model.interreflection`, in `unit`; None for no interreflection.
        noise: Noise model; `inverse_sigma` derives from its σ.
        confidence: Confidence of the normals, `LEAST_CONFIDENCE` to 1; None if all are equally reliable.
        place: x of `factorlib.light.distance`, in the block's frame; None if all points lie at the centre.
        row: Index of the observation among all usable ones.
        background: Surroundings that the photos show; None if they are not used.
        ground: Patches of the ground, whose radiance is relative to what it would be without shadows; None without.
        detail: Factor on the diffuse reflectance of each observation's material, per channel; None for 1.
        given_normal: Normals of the mesh as given, where `normal` is another (`Observations.cell_normal`).
        object: Number of the object in its photo; None if photos show one object each.
        by_turns: ∂y/∂η of the radiance, channel by turn (`factorlib.inference.model.normal_errors`), in `unit`; None
            for sure normals.
    """

    name: str
    photos: tuple[str, ...]
    unit: float
    normal: Float[np.ndarray, "n 3"]
    view: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    clipped: Bool[np.ndarray, "n 3"]
    inverse_sigma: Float[np.ndarray, "n 3"]
    material: Int[np.ndarray, " n"]
    photo: Int[np.ndarray, " n"]
    held_out: Bool[np.ndarray, " n"]
    visibility: UInt8[np.ndarray, "n k"] | None = None
    directions: Float[np.ndarray, "f k 3"] | None = None
    bounced: Float[np.ndarray, "n 6"] | None = None
    noise: Noise = Noise()
    confidence: Float[np.ndarray, " n"] | None = None
    place: Float[np.ndarray, "n 3"] | None = None
    row: Int[np.ndarray, " n"] | None = None
    background: Background | None = None
    ground: Block | None = None
    detail: Float[np.ndarray, "n 3"] | None = None
    given_normal: Float[np.ndarray, "n 3"] | None = None
    object: Int[np.ndarray, " n"] | None = None
    by_turns: Float[np.ndarray, "n 3 q"] | None = None

    def __len__(self) -> int:
        return len(self.material)

    @property
    def cell_normal(self) -> Float[np.ndarray, "n 3"]:
        """Normals of the mesh as given, which clusters are made of, like all cells (`Observations.cell_normal`)."""
        return self.normal if self.given_normal is None else self.given_normal

    @property
    def turns(self) -> int:
        """Number q of unknown turns of normals."""
        return 0 if self.by_turns is None else self.by_turns.shape[2]

    def take(self, rows: np.ndarray | slice) -> Block:
        """Return the observations `rows` (indices or a mask) alone."""
        values = ((name, getattr(self, name)) for name in PER_OBSERVATION)
        return msgspec.structs.replace(
            self, **{name: values_of_column[rows] for name, values_of_column in values if values_of_column is not None}
        )

    def subsample(self, count: int, seed: int) -> Block:
        """Return at most `count` fitted and `count` held-out observations, in their order.

        The sample is systematic (Madow and Madow 1944): observations are ordered by material and cluster, at random
        within one, and drawn at even steps from a random start.  So each region of the light has its share of the
        sample, where an independent draw leaves some without.
        """
        random = np.random.default_rng(seed)
        order = np.lexsort((random.random(len(self)), self.clusters(), self.material))
        samples = []
        for rows in (order[~self.held_out[order]], order[self.held_out[order]]):
            steps = np.arange(count) * len(rows) + random.integers(max(len(rows), 1))
            samples.append(rows[steps // count] if len(rows) > count else rows)
        return self.take(np.sort(np.concatenate(samples)))

    def with_effects(self, shadows: bool, bounces: bool) -> Block:
        """Return the same observations with shadows or interreflection switched off where the argument is False.

        Interreflection and the ground need shadows.
        """
        visibility = self.visibility if shadows else None
        bounced = self.bounced if shadows and bounces else None
        ground = self.ground if shadows else None
        return msgspec.structs.replace(self, visibility=visibility, bounced=bounced, ground=ground)

    def with_background_width(self, width: float) -> Block:
        """Return the same observations with this width of the errors of their background, if they have one."""
        if self.background is None:
            return self
        return msgspec.structs.replace(self, background=msgspec.structs.replace(self.background, width=float(width)))

    def with_noise(self, noise: Noise) -> Block:
        """Return the same observations under another noise model."""
        return msgspec.structs.replace(
            self,
            inverse_sigma=self.inverse_sigma * self.noise.sigma(self.radiance) / noise.sigma(self.radiance),
            noise=noise,
        )

    def on_surface(self, normal: Float[np.ndarray, "n 3"], detail: Float[np.ndarray, "n 3"]) -> Block:
        """Return the same observations with other normals and with a detail of reflectance.

        The block must have no detail yet.
        """
        bounced = None if self.bounced is None else self.bounced * np.hstack([detail, np.ones_like(detail)])
        return msgspec.structs.replace(
            self, normal=normal, detail=detail, bounced=bounced, given_normal=self.cell_normal
        )

    def residuals(self, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the whitened residuals of a predicted `radiance`, which is in the block's unit.

        A clipped channel is a lower bound: it has a residual only where the prediction is too dark.
        """
        difference = (radiance - self.radiance) * self.inverse_sigma
        return np.where(self.clipped, np.minimum(difference, 0.0), difference)

    def clusters(self) -> Int[np.ndarray, " n"]:
        """Return the number, from 0, of each observation's cluster.

        The observations of a cluster mirror one region of the light, so that their residuals are correlated.
        """
        return np.unique(mirror_cells(self.cell_normal, self.view, CLUSTER), return_inverse=True)[1].reshape(-1)
