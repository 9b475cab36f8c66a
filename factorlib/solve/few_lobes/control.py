"""The control of a descent: how much damping the next step gets, and when to stop."""

from __future__ import annotations

import msgspec

LESS, MORE = 2.5, 3.0  # the damping is divided by LESS after a good step, multiplied by MORE after a bad one
GOOD, BAD = 0.6, 0.2  # a step is good or bad if the loss fell by more or less than this share of the predicted decrease
LEAST_DAMPING = 1e-9
ENOUGH = 2  # steps in a row


class Damping(msgspec.Struct, frozen=True):
    """Levenberg–Marquardt damping: `value` times its diagonal is added to the Hessian."""

    value: float = 1e-3

    def after(self, gained: float, predicted: float) -> Damping:
        """Less where a step lowered the loss about as predicted, more where it did not.

        >>> Damping(1.0).after(gained=0.9, predicted=1.0), Damping(1.0).after(gained=-0.1, predicted=1.0)
        (Damping(value=0.4), Damping(value=3.0))
        """
        share = gained / max(predicted, 1e-300)
        return Damping(
            max(self.value / LESS, LEAST_DAMPING) if share > GOOD else self.value if share > BAD else self.value * MORE
        )


class Termination(msgspec.Struct, frozen=True):
    """Counts steps in a row that gain too little: they lower the loss by less than `tolerance` of it, or fail and promised less."""

    tolerance: float = 1e-4
    small: int = 0

    def after(self, gained: float, predicted: float, loss: float) -> Termination:
        """The count after a step; `loss` is the loss before it."""
        least = self.tolerance * loss
        if gained > 0:
            return Termination(self.tolerance, self.small + 1 if gained < least else 0)
        return Termination(self.tolerance, self.small + (predicted < least))

    @property
    def reached(self) -> bool:
        """Whether the descent ends: ENOUGH steps in a row gained too little."""
        return self.small >= ENOUGH
