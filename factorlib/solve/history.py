"""What a solve says on its way: every accepted point."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from factorlib.solve.descent import Solution
from factorlib.solve.held_out import held_out_loss
from factorlib.solve.normal_equations import Loss
from factorlib.solve.problem import Block


class Event(msgspec.Struct, frozen=True):
    """One accepted point: `loss` per fitted channel value, whitened (1 = explained to the noise model)."""

    round: int
    phase: str
    iteration: int
    loss: float
    held_out: float
    lobes: int


Report = Callable[[Event], None]
Snapshot = Callable[[Event, Solution], None]  # is handed every accepted point itself


def unwatched(event: Event, solution: Solution) -> None:
    """Nobody asked for snapshots."""


def recorder(blocks: Sequence[Block], history: list[Event], operator, loss: Loss, report: Report, snapshot: Snapshot) -> Callable:
    def record(round_: int, phase: str, iteration: int, solution: Solution) -> float:
        held = held_out_loss(blocks, solution.materials, solution.lights, operator, loss) if iteration < 0 else np.nan
        fitted = sum(int((~b.held_out).sum()) * 3 for b in blocks)
        history.append(Event(round_, phase, iteration, solution.loss / fitted, held, sum(map(len, solution.lights))))
        report(history[-1])
        snapshot(history[-1], solution)
        return held

    return record
