"""Photos of the body in lights that cost nothing to make, for tests."""

import numpy as np

from factorlib.conventions import lat_long_directions
from studies.core.baselines.case import Comparison, Joint
from studies.core.baselines.photos import Photos, photographed
from studies.core.study import full_matrix
from studies.core.world import materials_of


def light(seed: int, rows: int = 32) -> np.ndarray:
    """An even sky with a few coloured lamps, mean radiance about 1."""
    rng = np.random.default_rng(seed)
    directions, found = lat_long_directions(rows, 2 * rows), np.full((rows, 2 * rows, 3), 0.4)
    for axis in rng.normal(size=(4, 3)):
        found += (
            rng.uniform(0.5, 4, 3)
            * np.exp(rng.uniform(5, 60) * (directions @ (axis / np.linalg.norm(axis)) - 1))[..., None]
        )
    return found


def case(method: str, side: int = 3, size: int = 24, seed: int = 0) -> Comparison:
    """All of so many materials in as many lights."""
    return Comparison(seed, tuple(full_matrix(side, side)), method, size, Joint(12, 2))


def lights(seed: int, count: int = 4) -> dict[int, np.ndarray]:
    """Of a world."""
    return {li: light(100 * seed + li) for li in range(count)}


def photos(of: Comparison) -> Photos:
    """What a case sees."""
    return photographed(of, materials_of(of.seed), lights(of.seed))
