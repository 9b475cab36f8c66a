"""The verdict: a reference for its one integral, and what must hold whatever the weights are."""

from typing import get_args, get_type_hints

import msgspec
import numpy as np
import pytest

from factorlib.evaluate.ball import ball, constant_light, octahedral_light
from factorlib.evaluate.relighting import MEAN_SHOWN, NORMALS
from factorlib.evaluate.verdict import GOOD, POOR, VerdictInputs, ball_changes, verdict, verdict_text
from factorlib.results.materials import Misfit, Reflectance, StandardErrors, solved
from factorlib.results.metrics import Verdict
from factorlib.runner.verbs import NO_TRUST
from tests.evaluate.made_artifacts import TRUE, light_map

LIGHT = octahedral_light(light_map(1))
CLEAN = VerdictInputs(
    {"red": 1e-4, "wood": 2e-4}, 1e-4, {"day": Misfit(1e-4, 0.01), "dusk": Misfit(2e-4, 0.0)}, {"day": {"chair": 1e-4}}
)
WORSE = {
    "materials": {"red": 1e-4, "wood": 0.2},
    "photos": {"day": Misfit(1e-4, 0.01), "dusk": Misfit(2e-4, 0.9)},
    "unexplained": 2.0,
    "contours": {"day": {"chair": 1e-4}, "dusk": {"stool": 0.04}},
}
UNEXPLAINED = {"day": Misfit(0.2, 0.01), "dusk": Misfit(0.5, 0.0)}
BLAMED = {"materials": "'wood'", "photos": "'dusk'", "unexplained": "'dusk'", "contours": "'stool' in 'dusk'"}


def test_clean_signs_are_good_and_each_sign_alone_can_spoil_the_trust_and_is_the_first_reason():
    assert verdict(CLEAN).trust == "good" and verdict(CLEAN).expected_relit_db > GOOD
    for name, worse in WORSE.items():
        photos = {"photos": UNEXPLAINED} if name == "unexplained" else {}
        spoilt = verdict(msgspec.structs.replace(CLEAN, **{name: worse, **photos}))
        assert spoilt.trust == NO_TRUST and spoilt.expected_relit_db < POOR, name
        assert BLAMED[name] in spoilt.reasons[0] and "'" in spoilt.next, name


def test_a_worse_sign_never_raises_what_is_expected():
    levels = np.linspace(0, 1, 6)
    for name in ("materials", "unexplained", "clipped", "contours"):
        signs = [
            VerdictInputs(
                {"red": 1e-3 + 0.1 * v * (name == "materials")},
                1e-3 + v * (name == "unexplained"),
                {"day": Misfit(1e-3, v * (name == "clipped"))},
                {"day": {"chair": 0.01 * v * (name == "contours")}},
            )
            for v in levels
        ]
        assert (np.diff([verdict(of).expected_relit_db for of in signs]) < 0).all(), name


def test_a_materials_error_is_the_mean_square_of_what_random_errors_of_that_size_change():
    errors = StandardErrors((0.01, 0.004, 0.004), (0.004,) * 3, 0.01)
    (found,) = ball_changes({"red": solved(TRUE["red"], errors)}, {"day": LIGHT}).values()

    def shown(material: Reflectance) -> np.ndarray:
        return np.clip(ball(LIGHT, material, NORMALS) * exposure, 0, 1) ** (1 / 2.2)

    exposure = MEAN_SHOWN / ball(LIGHT, TRUE["red"], NORMALS).mean()
    rng, squares = np.random.default_rng(0), []
    for _ in range(60):
        a, b, c = rng.normal(size=3)
        moved = Reflectance(
            tuple(np.add(TRUE["red"].diffuse, np.multiply(errors.diffuse, a))),
            tuple(np.add(TRUE["red"].specular, np.multiply(errors.specular, b))),
            TRUE["red"].roughness + errors.roughness * c,
        )
        squares.append(np.mean((shown(moved) - shown(TRUE["red"])) ** 2))
    assert found == pytest.approx(np.mean(squares), rel=4 / np.sqrt(60))
    nothing = StandardErrors((0.0,) * 3, (0.0,) * 3, 0.0)
    assert ball_changes({"red": solved(TRUE["red"], nothing)}, {"day": LIGHT, "grey": constant_light(np.ones(3))}) == {
        "red": 0.0
    }


def test_the_text_begins_with_the_word_that_the_runner_looks_for():
    spoilt = msgspec.structs.replace(CLEAN, unexplained=2.0)
    first, *others = verdict_text(verdict(spoilt)).splitlines()
    assert first.startswith(NO_TRUST) and NO_TRUST in get_args(get_type_hints(Verdict)["trust"])
    assert others[0].startswith("limited by: ") and others[-1].startswith("next: ")
