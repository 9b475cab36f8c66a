"""Which of an object's poses explains a photo's shading: the one found, that one moved by shading, or the runner-up.

Each candidate gets a light of its own, fitted to the pixels that are not held out; the lobes are the same for all candidates, the
weights are not.  The candidates are compared on the held-out pixels that all of them show.  A candidate replaces the pose found if

    its held-out loss is lower by the share `least_gain`,
    the difference is more than SURE standard errors, with cells as independent samples, and
    its labelled IoU is lower by `most_lost` at most (`rival` for the runner-up).

The standard error does not matter where the IoU is higher by more than `most_lost`: then silhouette and shading agree.  By the same
rule a runner-up is ruled out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.align.refine import refined
from factorlib.align.state import State
from factorlib.model.noise import Loss
from factorlib.refine.descent import Moving, descended
from factorlib.refine.light import pursued_light, robust_scale, together, with_weights

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
SURE = 2.0
ROUNDS = 6  # of pursuit: with 3, the residual of glossy materials depends on which lobes were found first
LEAST_SHOWN = 100  # pixels, of each kind


class Standards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When a pose is replaced."""

    least_gain: Share = 0.03
    """Share of the held-out loss by which another pose must lower it."""
    most_lost: Share = 0.01
    """Overlap of mesh and mask that a pose may lose by moving."""
    rival: Share = 0.05
    """A runner-up whose overlap is less by no more than this is tried."""
    steps: Annotated[int, msgspec.Meta(ge=0, le=100)] = 8
    """Gauss-Newton steps of a pose."""


class Judged(msgspec.Struct, frozen=True):
    """A candidate.

    name:           found, moved or runner_up
    score:          its labelled IoU
    held_out_loss:  mean over the held-out pixels that all candidates show
    of_cells:       that loss summed over the pixels of each cell, the cells in one order for all candidates
    """

    name: str
    state: State
    score: float
    held_out_loss: float
    of_cells: Float[np.ndarray, " k"]

    def gain(self, over: Judged) -> tuple[float, float]:
        """Return by what share of the loss of `over` this one's is less, and the standard error of that share."""
        return gain_of(over.of_cells, self.of_cells)


class Settled(msgspec.Struct, frozen=True):
    """The decision of one object.

    chosen      name of the candidate to use; "found" where nothing is better
    candidates  every candidate that was compared, by name
    ruled_out   whether the runner-up explains the shading clearly worse; None where none was tried, or it is chosen
    """

    chosen: str
    candidates: dict[str, Judged]
    ruled_out: bool | None


def settled(
    moving: Moving, found: State, runner_up: State | None, cell: Int[np.ndarray, " n"], standards: Standards
) -> Settled | None:
    """Return which candidate to use; None where the candidates share too few pixels to compare them.

    cell: number of each pixel's cell
    """
    candidates = {"found": found}  # as it is; the others move, first by contours, then by shading too
    for name, start in (("moved", found), ("runner_up", runner_up)):
        if start is not None:
            start = refined(moving.caster, moving.target, moving.camera, start, moving.prior, standards.steps).state
            candidates[name] = descended(moving, start, standards.steps, standards.most_lost)
    if runner_up is not None and moving.score(candidates["runner_up"]) < moving.score(found) - standards.rival:
        del candidates["runner_up"]
    verdicts = judged(moving, candidates, cell)
    return choice_of(verdicts, standards) if verdicts else None


def choice_of(verdicts: Sequence[Judged], standards: Standards) -> Settled:
    """Choose one of the `judged` candidates; the first is the pose found."""
    best = found = verdicts[0]
    for one in sorted(verdicts[1:], key=lambda one: one.held_out_loss, reverse=True):
        best = one if is_better(one, found, standards) else best
    named = {one.name: one for one in verdicts}
    other = named.get("runner_up")
    own = min((one for one in verdicts if one is not other), key=lambda one: one.held_out_loss)
    ruled_out = None if other is None or best is other else is_better(own, other, standards)
    return Settled(best.name, named, ruled_out)


def judged(moving: Moving, states: dict[str, State], cell: Int[np.ndarray, " n"]) -> list[Judged]:
    """Every candidate, in the order of `states`; an empty list where too few pixels are shown by all of them."""
    blocks = {name: moving.block(state, None) for name, state in states.items()}
    common = np.logical_and.reduce([agrees for _, agrees in blocks.values()])
    held_out = next(iter(blocks.values()))[0].held_out
    if min((common & held_out).sum(), (common & ~held_out).sum()) < LEAST_SHOWN:
        return []
    surfaces, residual = moving.surfaces, {}
    fitted = {name: block.take(agrees & ~held_out) for name, (block, agrees) in blocks.items()}
    lobes = together([pursued_light(block, surfaces, ROUNDS) for block in fitted.values()])
    for name, (block, _) in blocks.items():
        light = with_weights(surfaces.under(lobes, fitted[name]))
        residual[name] = surfaces.under(light, block.take(common & held_out)).residuals()
    loss = Loss(min(robust_scale(r) for r in residual.values()))
    losses = {name: loss.of_residuals(r).mean(1) for name, r in residual.items()}
    number = np.unique(cell[common & held_out], return_inverse=True)[1].reshape(-1)
    return [
        Judged(name, state, moving.score(state), float(losses[name].mean()), np.bincount(number, weights=losses[name]))
        for name, state in states.items()
    ]


def gain_of(before: Float[np.ndarray, " k"], after: Float[np.ndarray, " k"]) -> tuple[float, float]:
    """1 − Σ after / Σ before of the cells' losses, and its standard error by the scatter of the cells' differences.

    Which of two candidates comes first changes the difference's sign and nothing else.

    >>> gain_of(np.array([2.0, 2.0]), np.array([1.0, 1.0]))
    (0.5, 0.0)
    """
    total, count, difference = max(float(before.sum()), 1e-300), len(before), before - after
    scatter = float(np.sum((difference - difference.mean()) ** 2)) * count / (count - 1) if count > 1 else np.inf
    return float(difference.sum()) / total, float(np.sqrt(scatter)) / total


def is_better(one: Judged, than: Judged, standards: Standards) -> bool:
    """Return whether `one` replaces `than`, by the rule above."""
    (gain, stderr), more = one.gain(than), one.score - than.score
    lost = standards.rival if "runner_up" in (one.name, than.name) else standards.most_lost
    agreed = more > standards.most_lost or gain > SURE * stderr
    return gain > standards.least_gain and agreed and more >= -lost
