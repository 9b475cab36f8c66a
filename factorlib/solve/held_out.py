"""The loss of held-out observations, which chooses models: whether a round gained, shadows, specular parts, tone curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from factorlib.solve.descent import Solution
from factorlib.solve.normal_equations import Loss, predicted_radiance, residuals, robust_losses
from factorlib.solve.problem import Block, of_rows
from factorlib.solve.unknowns import Light, Materials

Judge = Callable[[Sequence[Block], Solution], list[Float[np.ndarray, "n"]]]  # the losses of what is held out of each block


def held_out_of(block: Block, none: bool) -> Block:
    """What is held out of the block; all of it where `none` is held out of any."""
    return of_rows(block, block.held_out | none)


def none_held_out(blocks: Sequence[Block]) -> bool:
    return not any(block.held_out.any() for block in blocks)


def held_out_loss(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss) -> float:
    """Mean robust loss per held-out channel value; of all values where none is held out."""
    none = none_held_out(blocks)
    losses = np.concatenate(losses_of([held_out_of(block, none) for block in blocks], materials, lights, operator, loss))
    return float(losses.mean()) if len(losses) else 0.0


def losses_of(
    blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss
) -> list[Float[np.ndarray, "n"]]:
    """Robust loss of every observation, mean over its channels, block by block."""
    residual = [residuals(b, predicted_radiance(b, light, materials, operator)) for b, light in zip(blocks, lights, strict=True)]
    return [robust_losses(of_block, loss.robust_scale).mean(1) for of_block in residual]
