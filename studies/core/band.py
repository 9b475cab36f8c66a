"""A case of the study of operators: samples of a band of roughness."""

from __future__ import annotations

import msgspec


class Band(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """low, high: roughness;  samples: how many"""

    seed: int
    operator: str
    low: float
    high: float
    samples: int

    @property
    def middle(self) -> float:
        """The roughness that is rendered: α is spread evenly in its logarithm."""
        return (self.low * self.high) ** 0.5
