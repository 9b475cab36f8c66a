"""Which materials and lights are linked."""

import numpy as np

from factorlib.model.components import connected_components
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("closed_form", dtype="float64")


def test_components_of_unlinked_photos():
    rng = np.random.default_rng(6)
    blocks = [
        block(name, random_light(rng, 1), MATERIALS, shown, OPERATOR, size=8)
        for name, shown in (("a", [0, 1]), ("b", [2]))
    ]
    assert connected_components(blocks, 4) == [((0, 1), ("a",)), ((2,), ("b",)), ((3,), ())]
