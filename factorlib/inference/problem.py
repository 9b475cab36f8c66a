"""The joint problem: what is known about materials and lights, and every question that can be asked about a point.

    problem = JointProblem(blocks, operator, loss, spread)      point = Point(materials, lights)
    problem.radiance(point)   .residuals(point)   .held_out_loss(point)

Every observation depends on one material (7 unknowns) and one light (3 unknowns a cell, exposures, tone curves).  So questions are answered illumination by
illumination (`factorlib.inference.forward`), and `spread` may do that on several workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.inference.blocks import Block
from factorlib.inference.forward import Illumination
from factorlib.inference.known import Known
from factorlib.inference.materials import Point
from factorlib.inference.noise import Loss
from factorlib.inference.responses import Tables
from factorlib.reflection.operator import Operator
from factorlib.stage import serial_map

Spread = Callable[[Callable, Iterable], Iterable]  # an ordered map over independent work


class JointProblem(msgspec.Struct, frozen=True):
    """What is known: observations by illumination, how lobes are reflected, what a residual costs, how to spread work, and unknowns whose values are given."""

    blocks: list[Block]
    operator: Operator
    loss: Loss = Loss()
    spread: Spread = serial_map
    known: Known = Known()
    tables: Tables = msgspec.field(default_factory=Tables)

    def illuminations(self, point: Point) -> list[Illumination]:
        """Each block with its light; raises ValueError where there is not one light per block."""
        return [
            Illumination(b, light, point.materials, self.operator)
            for b, light in zip(self.blocks, point.lights, strict=True)
        ]

    def radiance(self, point: Point) -> list[Float[np.ndarray, "n 3"]]:
        """What every observation should show, block by block, in the block's unit."""
        return [illumination.radiance() for illumination in self.illuminations(point)]

    def residuals(self, point: Point) -> list[Float[np.ndarray, "n 3"]]:
        """Whitened residuals, block by block, one-sided where clipped; held-out observations too."""
        return [illumination.residuals() for illumination in self.illuminations(point)]

    def held_out_losses(self, point: Point) -> list[Float[np.ndarray, " n"]]:
        """Robust loss of each held-out observation, block by block; if no observation at all is held out, of each observation."""
        judged = self.of([block.take(block.held_out | self.none_held_out) for block in self.blocks])
        return [illumination.losses(self.loss) for illumination in judged.illuminations(point)]

    def held_out_loss(self, point: Point) -> float:
        """Mean robust loss per held-out channel value; if none is held out, of all values."""
        losses = np.concatenate(self.held_out_losses(point))
        return float(losses.mean()) if len(losses) else 0.0

    @property
    def has_bounces(self) -> bool:
        """Whether it is known what surfaces send to each other in any block."""
        return any(block.bounced is not None for block in self.blocks)

    @property
    def none_held_out(self) -> bool:
        """Whether all observations are fitted, so that none can choose a model."""
        return not any(block.held_out.any() for block in self.blocks)

    def sampled(self, count: int | Sequence[int], seed: int) -> JointProblem:
        """Return the problem with at most `count` fitted observations of each block (one number, or one a block), and a third as many held out."""
        counts = [count] * len(self.blocks) if isinstance(count, int) else count
        return self.of([block.sampled(most, seed) for block, most in zip(self.blocks, counts, strict=True)])

    def fitted(self) -> JointProblem:
        """The observations that are not held out."""
        return self.of([block.fitted() for block in self.blocks])

    def restricted(self, lights: Sequence[int]) -> JointProblem:
        """The blocks of numbers `lights` alone."""
        return self.of([self.blocks[k] for k in lights])

    def with_effects(self, shadows: bool, bounces: bool) -> JointProblem:
        """The same observations, as if meshes cast no shadows, or as if what hides the light were black."""
        return self.of([block.with_effects(shadows, bounces) for block in self.blocks])

    def with_none_held_out(self) -> JointProblem:
        """The same observations, all to be fitted."""
        return self.of([block.with_none_held_out() for block in self.blocks])

    def of(self, blocks: list[Block]) -> JointProblem:
        """The same question of other observations."""
        return msgspec.structs.replace(self, blocks=blocks)
