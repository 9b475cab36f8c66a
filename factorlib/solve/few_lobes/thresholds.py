"""How much better a richer model must explain held-out observations to be used, with the measurement behind each number."""

from __future__ import annotations

import msgspec


class Threshold(msgspec.Struct, frozen=True):
    """When the richer model is kept: without it, the loss of the observations that decide is higher by more than the share `gain`, or
    the loss of all observations that were compared by more than the share `harm`."""

    gain: float
    harm: float = float("inf")


# The held-out loss of all observations moves by some 3 % as a descent goes on: less says nothing of a specular part.
SPECULAR = Threshold(gain=0.03, harm=0.05)

NEEDED_EARLY = (
    1.3  # times the held-out loss: if it is higher after a few iterations without a specular part, that part is needed
)

LEAST_DECREASE = (
    0.005  # of the held-out loss by a round, in σ² of the noise model: a smaller decrease is the operator's error
)
HALVED = (
    0.5  # a round that lowers the fitted loss to this share is not the last: few held-out observations are a noisy vote
)
