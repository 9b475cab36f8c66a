"""Joint problem: the given observations and operator, and the evaluation of any point.

    problem = JointProblem(blocks, operator, spread)      point = Point(materials, lights)
    problem.radiance(point)   .residuals(point)   .held_out_loss(point)

Every observation depends on one material (7 unknowns) and one light (3 unknowns a cell, exposures, tone curves).
Points are therefore evaluated illumination by illumination (`factorlib.inference.model.forward`), and `spread` may do
that on several workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.inference.model.blocks import COMPARISON_LOSS, Block
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.known import KnownValues
from factorlib.inference.model.materials import Point
from factorlib.inference.model.responses import ResponseCache
from factorlib.reflection.operator import Operator
from factorlib.stage import serial_map

Spread = Callable[[Callable, Iterable], Iterable]  # an ordered map over independent work


class JointProblem(msgspec.Struct, frozen=True):
    """Joint problem: observations, reflection operator and known values, by which any point is evaluated.

    Attributes:
        blocks: Observations by illumination.
        operator: Reflection operator of lobes.
        spread: Map over independent work.
        known: Unknowns with given values.
        tables: Cache of response tables.
    """

    blocks: list[Block]
    operator: Operator
    spread: Spread = serial_map
    known: KnownValues = KnownValues()
    tables: ResponseCache = msgspec.field(default_factory=ResponseCache)

    def illuminations(self, point: Point) -> list[Illumination]:
        """Return each block with its light.

        Raises:
            ValueError: If there is not one light per block.
        """
        return [
            Illumination(b, light.with_turns(b.turns), point.materials, self.operator)
            for b, light in zip(self.blocks, point.lights, strict=True)
        ]

    def tabulated(self, point: Point) -> list[Illumination]:
        """Return each block with its light and the table of responses at the roughness of the materials."""
        fixed = point.materials.roughness
        return [
            msgspec.structs.replace(
                each, table=self.tables.get(each.block, each.light.unit_lobes, self.operator, fixed)
            )
            for each in self.illuminations(point)
        ]

    def radiance(self, point: Point) -> list[Float[np.ndarray, "n 3"]]:
        """Return the predicted radiance of every observation, block by block, in the block's unit."""
        return [illumination.radiance() for illumination in self.illuminations(point)]

    def residuals(self, point: Point) -> list[Float[np.ndarray, "n 3"]]:
        """Return whitened residuals of all observations, block by block, one-sided where clipped."""
        return [illumination.residuals() for illumination in self.illuminations(point)]

    def held_out(self) -> JointProblem:
        """Return the problem of the held-out observations; of all of them if none is held out."""
        return self.with_blocks([block.take(block.held_out | self.none_held_out) for block in self.blocks])

    def losses(self, point: Point) -> list[Float[np.ndarray, " n"]]:
        """Return the robust loss of each observation, block by block."""
        return [illumination.losses(COMPARISON_LOSS) for illumination in self.illuminations(point)]

    def held_out_loss(self, point: Point) -> float:
        """Return the mean robust loss per held-out channel value; of all values if none is held out."""
        return mean_loss(self.held_out().losses(point))

    def fitted_loss(self, point: Point) -> float:
        """Return the mean robust loss per fitted channel value."""
        return mean_loss(self.without_held_out().losses(point))

    @property
    def has_bounces(self) -> bool:
        """True if the interreflection of any block is known."""
        return any(block.bounced is not None for block in self.blocks)

    @property
    def none_held_out(self) -> bool:
        """True if all observations are fitted, so that none can select a model."""
        return not any(block.held_out.any() for block in self.blocks)

    def subsample(self, count: int, seed: int) -> JointProblem:
        """Return the problem with at most `count` fitted and `count` held-out observations of each block."""
        return self.with_blocks([block.subsample(count, seed) for block in self.blocks])

    def without_held_out(self) -> JointProblem:
        """Return the problem without its held-out observations."""
        return self.with_blocks([b.take(~b.held_out) if b.held_out.any() else b for b in self.blocks])

    def with_all_fitted(self) -> JointProblem:
        """Return the problem with its held-out observations among the fitted ones."""
        return self.with_blocks([msgspec.structs.replace(b, held_out=np.zeros_like(b.held_out)) for b in self.blocks])

    def select_lights(self, lights: Sequence[int]) -> JointProblem:
        """Return the problem with the selected blocks alone."""
        return self.with_blocks([self.blocks[k] for k in lights])

    def with_effects(self, shadows: bool, bounces: bool) -> JointProblem:
        """Return the problem with shadows or interreflection switched off where the argument is False."""
        return self.with_blocks([block.with_effects(shadows, bounces) for block in self.blocks])

    def keep_backgrounds(self, widths: Sequence[float]) -> JointProblem:
        """Return the problem with backgrounds of these widths, in order of lights; 0 leaves one out, and [] all."""
        problem = self._keep("background", [width > 0 for width in widths])
        pairs = zip(problem.blocks, widths or [0.0] * len(problem.blocks), strict=True)
        return self.with_blocks([block.with_background_width(width) for block, width in pairs])

    def keep_grounds(self, keep: Sequence[bool]) -> JointProblem:
        """Return the problem with the grounds of those lights alone for which `keep` is True; empty for none."""
        return self._keep("ground", keep)

    def _keep(self, part: str, keep: Sequence[bool]) -> JointProblem:
        """Return the problem without a part of those blocks for which `keep` is False."""
        pairs = zip(self.blocks, keep or [False] * len(self.blocks), strict=True)
        return self.with_blocks([b if kept else msgspec.structs.replace(b, **{part: None}) for b, kept in pairs])

    def with_blocks(self, blocks: list[Block]) -> JointProblem:
        """Return the problem with other observations."""
        return msgspec.structs.replace(self, blocks=blocks)


def mean_loss(losses: list[Float[np.ndarray, " n"]]) -> float:
    """Return the mean over the losses of all blocks; 0 without any."""
    values = np.concatenate(losses)
    return float(values.mean()) if len(values) else 0.0
