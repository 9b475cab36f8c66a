"""A case: one photo of a data set in data/, and where its chairs are predicted from."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

FOLDER = "data/eames"  # of the data set, in the checkout
CHAIRS = {  # shells by photo: what is left out and predicted
    "terrace": ("red", "white"),
    "kitchen": ("yellow",),
    "hall": ("black", "yellow"),
    "garden": ("white",),
    "office": ("red",),
    "patio": ("black",),
}

Prediction = Literal["left out", "observed", "flat"]


class LeftOutCase(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is asked for.

    photo:       whose chairs are predicted, one at a time
    photos:      the set
    prediction:  left out: solved without the shell's pixels in this photo;  observed: solved with all pixels, so no prediction but
                 what the model can fit;  flat: no solve, the shell's mean colour elsewhere, in this photo's brightness
    solve:       parameters of the stage `solve` that differ from their defaults
    """

    photo: str
    photos: tuple[str, ...]
    prediction: Prediction
    solve: dict[str, Any] = {}

    @property
    def shells(self) -> tuple[str, ...]:
        """The materials that are left out one at a time."""
        return tuple(
            shell
            for shell in CHAIRS[self.photo]
            if any(shell in CHAIRS[other] for other in self.photos if other != self.photo)
        )
