"""Observations under one illumination, in that illumination's frame and radiance unit."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from factorlib.geometry.sphere import mirror_cells
from factorlib.inference.noise import Noise

PER_OBSERVATION = (
    *("normal", "view", "radiance", "clipped", "precision", "material", "photo", "held_out"),
    *("visibility", "bounced", "confidence", "place", "row", "detail"),  # where the block has them
)
CLUSTER = 0.35  # size of a cluster's cell of mirror directions: 20°


class Block(msgspec.Struct, frozen=True):
    """The n observations under one illumination, sorted by material.

    unit        the block's mean radiance; `radiance` is divided by it
    precision   1/σ of the noise model times the root of the observation's weight; 0 where a channel says nothing
    held_out    observations that choose between models and are not fitted
    visibility  how much of each of k directions an observation sees, 0 (nothing) to 255 (all); None: all see everything
    directions  the k directions of `visibility`, in the block's frame, for each of the f photos
    noise       of which `precision` is the reciprocal
    confidence  how sure normals are, 0 to 1; None: all are as sure
    row         the observation's number among all usable ones
    detail      factor on the diffuse reflectance of each observation's material; None: 1
    place       x of `factorlib.light.distance`, in the block's frame; None: all lie in the middle
    bounced     what hidden directions send, by the cosine (RGB) and by a highlight (RGB): G_d and G_s of `factorlib.inference.interreflection`,
                in the block's unit; None: nothing
    """

    name: str
    photos: tuple[str, ...]
    unit: float
    normal: Float[np.ndarray, "n 3"]
    view: Float[np.ndarray, "n 3"]
    radiance: Float[np.ndarray, "n 3"]
    clipped: Bool[np.ndarray, "n 3"]
    precision: Float[np.ndarray, "n 3"]
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
    detail: Float[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return len(self.material)

    def take(self, rows: np.ndarray | slice) -> Block:
        """Return the observations `rows` (numbers or a mask) alone."""
        values = ((name, getattr(self, name)) for name in PER_OBSERVATION)
        return msgspec.structs.replace(self, **{name: of[rows] for name, of in values if of is not None})

    def fitted(self) -> Block:
        """The observations that are not held out."""
        return self.take(~self.held_out) if self.held_out.any() else self

    def with_none_held_out(self) -> Block:
        """The same observations, all to be fitted."""
        return msgspec.structs.replace(self, held_out=np.zeros(len(self), bool))

    def sampled(self, count: int, seed: int) -> Block:
        """Return at most `count` fitted and `count`/3 held-out observations, drawn at random, order kept."""
        random = np.random.default_rng(seed)
        kept = [
            random.permutation(rows)[:most]
            for rows, most in ((np.flatnonzero(~self.held_out), count), (np.flatnonzero(self.held_out), count // 3))
        ]
        return self.take(np.sort(np.concatenate(kept)))

    def with_effects(self, shadows: bool, bounces: bool) -> Block:
        """The same observations, as if nothing hid anything, or as if what hides the light were black."""
        visibility = self.visibility if shadows else None
        bounced = self.bounced if shadows and bounces else None
        return msgspec.structs.replace(self, visibility=visibility, bounced=bounced)

    def with_noise(self, noise: Noise) -> Block:
        """The same observations, which are expected to be off by as much as another noise model says."""
        return msgspec.structs.replace(
            self, precision=self.precision * self.noise.sigma(self.radiance) / noise.sigma(self.radiance), noise=noise
        )

    def on_surface(self, normal: Float[np.ndarray, "n 3"], detail: Float[np.ndarray, " n"]) -> Block:
        """The same observations of a surface with other normals and with that detail of reflectance, of which the block has none."""
        bounced = None if self.bounced is None else self.bounced * np.where(np.arange(6) < 3, detail[:, None], 1.0)
        return msgspec.structs.replace(self, normal=normal, detail=detail, bounced=bounced)

    def residuals(self, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return by how much `radiance`, in the block's unit, is too bright, in σ.  A clipped pixel says "at least": only too dark counts."""
        difference = (radiance - self.radiance) * self.precision
        return np.where(self.clipped, np.minimum(difference, 0.0), difference)

    def clusters(self) -> Int[np.ndarray, " n"]:
        """The number, from 0, of each observation's cluster: those that mirror one region of the light, whose residuals err alike."""
        return np.unique(mirror_cells(self.normal, self.view, CLUSTER), return_inverse=True)[1].reshape(-1)
