"""A chair that is left out: what is left of the photo, what can be said without a model of light, and the scores."""

import numpy as np
import pytest

from factorlib.urm.observations import Observations
from studies.catalogue.contents import STUDIES
from studies.core.left_out.case import CHAIRS, LeftOutCase
from studies.core.left_out.photos import flat_colour, without
from studies.core.left_out.score import Chair, score_of
from studies.core.study import FULL, QUICK
from studies.core.table import Cell, Conclusion, Row, Spread
from studies.run.project import photos_of
from studies.steps.left_out.conclude import by_photo, side_by_side

NAMES = ("red", "white", "wood")
ALBEDO = {"red": (0.5, 0.1, 0.1), "white": (0.8, 0.8, 0.7), "wood": (0.4, 0.3, 0.2)}
RNG = np.random.default_rng(0)


def photo(shown, light):
    """Ten pixels a material, flat in a light of one colour."""
    material = np.repeat([NAMES.index(name) for name in shown], 10)
    n, zero = len(material), np.zeros(len(material), int)
    radiance = np.array([ALBEDO[NAMES[m]] for m in material]) * np.array(light)
    normal = np.tile([0.0, 0.0, -1.0], (n, 1))
    return Observations(
        normal,
        normal,
        radiance,
        np.zeros((n, 3), bool),
        material,
        zero,
        zero,
        zero,
        zero,
        np.ones(n),
        NAMES,
        ("p",),
        ("p",),
    )


def test_what_is_left_is_everything_but_the_shell():
    left = without(photo(("red", "white", "wood"), (1, 1, 1)), "white")
    assert set(left.material.tolist()) == {0, 2} and len(left) == 20


def test_a_flat_colour_is_right_where_light_is_flat():
    """And needs nothing of the shell in the photo that is asked for."""
    seen = {
        "a": photo(("red", "wood"), (1, 2, 3)),
        "b": photo(("red", "white", "wood"), (3, 1, 1)),
        "c": photo(("wood",), (0.5, 0.7, 2)),
    }
    assert flat_colour(seen, "c", "red", "wood") == pytest.approx(np.array(ALBEDO["red"]) * (0.5, 0.7, 2))


def chair():
    truth = RNG.uniform(0.1, 1.0, (30, 40, 3))
    mask = np.zeros((30, 40), bool)
    mask[5:25, 5:35] = True
    return Chair("p", truth, mask)


def test_the_photo_itself_scores_nothing_and_a_tinted_one_only_when_it_is_not_scaled():
    one = chair()
    assert score_of([one], [one.truth]).values == {"chair": 0.0, "chair_scaled": 0.0}
    tinted = score_of([one], [one.truth * (0.5, 0.8, 1.1)])
    assert tinted.values["chair"] > 0.01 > 1e-6 > tinted.values["chair_scaled"]


def test_the_null_is_its_own_mean_colour():
    one = chair()
    flat = np.broadcast_to(one.truth[one.mask].mean(0), one.truth.shape)
    score = score_of([one], [flat])
    assert score.values["chair"] == score.nulls["chair"] > 0.05


def test_a_cut_out_is_white_outside_the_shell():
    cut = chair().cut_out(chair().truth)
    assert (cut[0] == 255).all() and (cut[10, 10] < 255).any()
    assert side_by_side([cut, cut[:20]]).shape == (len(cut), 2 * (cut.shape[1] + 8), 3)


def test_every_shell_is_in_another_photo_too():
    """Else nothing would tell its material once it is left out."""
    assert all(LeftOutCase(name, tuple(CHAIRS), "left out").shells == shells for name, shells in CHAIRS.items())
    assert LeftOutCase("hall", ("kitchen", "hall"), "left out").shells == ("yellow",)


def test_keys_have_what_the_photos_contain_and_neither_truth_nor_places():
    study = STUDIES["leave-one-out"]
    found = photos_of(next(iter(study.cases(QUICK).values())))
    assert found["photos"] == ["kitchen", "hall"] and found["folder"] == "data/eames"
    assert "photos/hall.jpg" in found["content"] and not any(
        name.startswith(("truth", "/")) for name in found["content"]
    )


def test_intervals_are_over_photos():
    study = STUDIES["leave-one-out"]
    assert study.seeds_of(FULL) == tuple(range(len(CHAIRS))) and len(study.cases(FULL)) == 3 * len(CHAIRS)
    assert {case.photo for case in study.cases(FULL).values()} == set(CHAIRS)


def test_a_note_gives_each_photos_values():
    rows = [
        Row(name, name, 0, {"chair": Cell(Spread(0.0, 2), dict(enumerate(of)))})
        for name, of in {"left out": (0.1, 0.2), "flat": (0.15, 0.123)}.items()
    ]
    found = Conclusion("x", "x", "?", "p", "v", "full", "", (0, 1), ("chair",), rows, [])
    assert (
        by_photo(found, {0: "hall", 1: "patio"})
        == "DSSIM of a chair, photo by photo (left out, flat): hall 0.1, 0.15; patio 0.2, 0.12."
    )
