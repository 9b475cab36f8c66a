"""What the solve does against wrong geometry, switched off.

The robust loss of few lobes has no switch for users, for nobody should want to do without.  Its scale is at least `LEAST_ROBUST_SCALE` σ of
the noise model (`factorlib.solve.few_lobes.rounds`); where that is so large that no residual reaches it, the loss is that of least squares.
The default solver has a robust loss of its own, with the same consequence for `ROBUST` (`factorlib.solve.fit`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from factorlib.model.loss import Loss
from factorlib.solve import fit
from factorlib.solve.few_lobes import rounds

BEYOND_ALL = 1e3  # σ: with more, √(1 + r²/k²) − 1 would lose its digits


@contextmanager
def robust_loss(kept: bool) -> Iterator[None]:
    """The solve within this process with its robust loss, or with least squares in its place."""
    before = rounds.LEAST_ROBUST_SCALE, fit.ROBUST
    if not kept:
        rounds.LEAST_ROBUST_SCALE, fit.ROBUST = BEYOND_ALL, Loss(BEYOND_ALL)
    try:
        yield
    finally:
        rounds.LEAST_ROBUST_SCALE, fit.ROBUST = before
