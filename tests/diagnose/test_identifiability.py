"""What is said of the lights' colour."""

import msgspec
import numpy as np
import pytest

from factorlib.diagnose.identifiability import tinted_alike
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light

NAMES = ("a", "b", "c")


@pytest.mark.parametrize(
    ("tints", "bounced", "said"),
    [
        ([[1, 3, 3], [1, 4, 3]], True, True),  # red is what surfaces are then
        ([[1, 3, 3], [1, 4, 3]], False, False),  # the rule of the gauge makes lights grey
        ([[1, 3, 3], [4, 1, 1]], True, False),  # one light is blue-green, another red: not alike
        ([[1, 1.3, 1.2], [1, 1.2, 1.5]], True, False),  # as natural lights are
    ],
)
def test_a_colour_that_all_lights_have_is_named_where_interreflection_fixes_it(tints, bounced, said):
    rng, operator = np.random.default_rng(0), reflection_operator("closed_form", dtype="float64")
    grey = [random_light(rng, 3) for _ in tints]
    grey = [
        msgspec.structs.replace(light, weight=np.repeat(light.weight.mean(1, keepdims=True), 3, axis=1))
        for light in grey
    ]
    blocks = [block(f"room{k}", light, MATERIALS, [0, 1, 2], operator, size=6) for k, light in enumerate(grey)]
    if bounced:
        blocks = [msgspec.structs.replace(one, bounced=np.zeros((len(one), 6))) for one in blocks]
    lights = [
        msgspec.structs.replace(light, weight=10.0**k * light.weight * tint)
        for k, (light, tint) in enumerate(zip(grey, tints, strict=True))
    ]
    sentences = tinted_alike(NAMES, blocks, lights)
    assert len(sentences) == said
    if said:
        assert (
            "room0, room1" in sentences[0]
            and "R : G : B = 0.4" in sentences[0]
            and "solve.interreflection=off" in sentences[0]
        )
