"""Perturbed observations are the same ones, up to rounding."""

import msgspec
import numpy as np

from factorlib.evaluate.ball import constant_light
from studies.core.case import Case
from studies.core.observed import observations_of
from studies.core.world import materials_of
from studies.rounding import PERTURBED, perturbed


def test_a_perturbation_moves_radiances_alone_and_as_far_as_it_says():
    case = Case(seed=0, entries=((0, 0), (1, 0)), size=12)
    (seen,) = observations_of(case, materials_of(0), {0: constant_light(np.ones(3))}).values()
    moved = perturbed(seen, np.random.default_rng(0))
    share = moved.radiance / seen.radiance - 1
    assert 0.5 * PERTURBED < share.std() < 2 * PERTURBED and np.abs(share).max() < 6 * PERTURBED
    assert msgspec.structs.replace(moved, radiance=seen.radiance).normal is seen.normal
    for name in ("material", "photo", "view", "weight"):
        assert getattr(moved, name) is getattr(seen, name)
