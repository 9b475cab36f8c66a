"""How much better a richer model must explain held-out observations to be used, with the measurement behind each number."""

from __future__ import annotations

import msgspec


class Threshold(msgspec.Struct, frozen=True):
    """When the richer model is kept: without it, the loss of the observations that decide is higher by more than the share `gain`, or
    the loss of all observations that were compared by more than the share `harm`."""

    gain: float
    harm: float = float("inf")


SHADOWS = Threshold(gain=0.0)  # both models have as many unknowns: whichever explains more

# σ² of the noise model.  Where lobes explain held-out observations better, the model of the scene is nearly exact, and lobes show its
# lights better than any lattice; where worse, its errors would become features of lobes, and lights follow the prior.  Between
# data/synthetic (.11) and eames-like sets (seed 11: 1.06 with bounces, 1.21 without).
WELL_EXPLAINED = 0.35
# Rounds.  The third lowers data/synthetic's held-out loss to .54 of what it was (.72 after it), that of eames-like sets to .9 (1.2).
ENOUGH = 3
HOPEFUL = 2.0  # times WELL_EXPLAINED: lobes that explain less are not brought nearer to their optimum, if lights may follow the prior

# As many unknowns, but the scale of reflectances is no longer free, and a wrong scale explains a little of what else is wrong with a model.
# Losses are geometric means over lights (`evidence.decide_over_lights`), gains those of `interreflection_chosen_by` in `materials.json`.
# Photos that show bounces: data/eames 38 %, the eames-like set of seed 12 26 %, bowls with normals wrong by 12 and 15° (five seeds of
# `tests/model/test_interreflection.py`) 31 to 178 %.  Photos that do not: a visual hull in the real set liberty 3.65 %, those bowls at most 4.8 %.
INTERREFLECTION = Threshold(gain=0.1)

# The held-out loss of all observations moves by some 3 % as a descent goes on: less says nothing of a specular part.
SPECULAR = Threshold(gain=0.03, harm=0.05)

# An exponent also fits some errors of the rest of the model, such as normals and reflections between objects.  So without a light's
# curves its held-out loss must be a quarter higher.
TONE = Threshold(gain=0.25)

PROMISED_BY_TONE = 0.05  # share of the fitted loss: curves are tried only if one step is predicted to gain more from them
NEEDED_EARLY = 1.3  # times the held-out loss: if it is higher after a few iterations without a specular part, that part is needed

FAR_BEHIND = 1.25  # a model whose held-out loss is this many times another's at the same round is given up
LEAST_DECREASE = 0.005  # of the held-out loss by a round, in σ² of the noise model: a smaller decrease is the operator's error
HALVED = 0.5  # a round that lowers the fitted loss to this share is not the last: few held-out observations are a noisy vote
