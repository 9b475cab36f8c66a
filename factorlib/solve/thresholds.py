"""How much better a richer model must explain held-out observations to be believed, with the measurement behind each number."""

from __future__ import annotations

import msgspec


class Threshold(msgspec.Struct, frozen=True):
    """The richer model stays where without it the loss is higher, of the observations in question by more than the share `gain`,
    or of all that were compared by more than the share `harm`."""

    gain: float
    harm: float = float("inf")


SHADOWS = Threshold(gain=0.0)  # both models have as many unknowns: whichever explains more

# The held-out loss of all observations moves by some 3 % as a descent goes on: less says nothing of a specular part.
SPECULAR = Threshold(gain=0.03, harm=0.05)

# An exponent also takes up some of what the rest of the model has wrong, normals and reflections between objects: a light's curves
# must lower its held-out loss by a fifth.
TONE = Threshold(gain=0.25)

PROMISED_BY_TONE = 0.05  # of the fitted loss: where one step of everything promises less of curves, none is tried
NEEDED_EARLY = 1.3  # times the held-out loss, after a few iterations without a specular part: it is needed, and no more is tried

FAR_BEHIND = 1.25  # a model whose held-out loss is this many times another's at the same round is given up
LEAST_DECREASE = 0.005  # of the held-out loss by a round, in σ² of the noise model: less is the operator's error, not the light
HALVED = 0.5  # a round that lowers the fitted loss to this share is not the last: few held-out observations are a noisy vote
