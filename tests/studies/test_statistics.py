"""A conclusion stands only where seeds leave no doubt; numbers here are made up."""

import msgspec
import numpy as np
import pytest
from scipy.stats import ttest_1samp

from studies.core.case import Score
from studies.core.statistics import difference, spread
from studies.core.study import FULL, QUICK, Claim, Guess, Rise, Setting, Study, case_name
from studies.report.conclusion import concluded
from studies.report.tables import answer_to_the_paper, csv_text, paragraph

SEEDS = FULL.seeds


def by_seed(*values):
    return dict(enumerate(values))


def test_the_interval_of_a_mean_is_that_of_the_t_test():
    values = [0.3, 0.5, 0.45, 0.6, 0.35]
    found, expected = spread(values), ttest_1samp(values, 0).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx(tuple(expected))
    assert found.mean == pytest.approx(0.44) and found.deviation == pytest.approx(np.std(values, ddof=1))


def test_one_seed_has_no_interval():
    assert spread([1.0]).low is spread([1.0]).deviation is None


def test_what_all_seeds_have_is_shown_though_seeds_lie_far_apart():
    """Paired: .1 better in each seed, among seeds that differ by 10."""
    worse = by_seed(1.0, 11.0, 5.0, 7.0, 3.0)
    better = {seed: value - 0.1 - 0.001 * seed for seed, value in worse.items()}
    assert difference(better, worse).verdict == "lower" and difference(worse, better).verdict == "higher"


def test_overlap_shows_nothing():
    assert difference(by_seed(0.1, 0.2, 0.3, 0.2, 0.1), by_seed(0.2, 0.1, 0.2, 0.3, 0.12)).verdict == "not shown"


def test_equal_numbers_show_nothing():
    same = by_seed(*[0.1] * 5)
    assert difference(same, same).verdict == "not shown"


@pytest.mark.parametrize("seeds", range(1, 5))
def test_fewer_than_five_seeds_show_nothing(seeds):
    low, high = by_seed(*[0.1 + 1e-9 * k for k in range(seeds)]), by_seed(*[0.9] * seeds)
    assert difference(low, high).verdict == "too few seeds"


def test_many_comparisons_take_more_than_one():
    """t = 3 on 4 degrees of freedom: beyond 2.78 for one, below 4.6 for five."""
    differences = np.array([1.0, -1.0, 0.0, 0.5, -0.5])
    differences = differences / differences.std(ddof=1) * 5**0.5 + 3
    low, high = by_seed(*-differences), by_seed(*np.zeros(5))
    assert difference(low, high, 1).verdict == "lower" and difference(low, high, 5).verdict == "not shown"


def test_only_seeds_that_both_have_are_compared():
    with pytest.raises(ValueError, match="no seed"):
        difference({0: 1.0}, {1: 1.0})
    assert difference({0: 1.0, 1: 2.0}, {1: 1.0, 2: 3.0}).spread.mean == 1.0


def study(*claims):
    made = [Setting(name, name, x, lambda seed: QUICK.case(seed, [(0, 0)])) for x, name in enumerate("ab")]
    return Study(
        "toy",
        "Toy <b>",
        "Which?",
        "a is better.",
        "letter",
        ("entries", "roughness"),
        lambda scale: made,
        lambda scale: list(claims),
    )


def scores(scale, **values):
    return {
        case_name(name, seed): Score({"entries": v + 0.001 * seed}, {"entries": 0.5})
        for name, v in values.items()
        for seed in scale.seeds
    }


CLAIM = Claim("entries", "a", "b", "a is better than b")


@pytest.mark.parametrize(
    "a, b, answer, words",
    [
        (0.1, 0.2, "agrees", ": shown ("),
        (0.2, 0.1, "disagrees", "the opposite is shown"),
        (0.1, 0.1, "no difference is shown", "no difference is shown"),
    ],
)
def test_the_sentence_says_what_was_found(a, b, answer, words):
    found = concluded(study(CLAIM), FULL, scores(FULL, a=a, b=b))
    assert words in paragraph(found) and answer_to_the_paper(found) == answer
    assert found.rows[0].cells["entries"].null == 0.5 and "roughness" not in found.rows[0].cells


@pytest.mark.parametrize("b, c, answer", [(0.5, 0.6, "agrees"), (0.5, 1.9, "disagrees")])
def test_rises_are_compared_per_unit(b, c, answer):
    """From a to b one unit, from b to c two: .4 and .05 or .7 a unit."""
    made = [Setting(name, name, x, lambda seed: QUICK.case(seed, [(0, 0)])) for x, name in enumerate("abc")]
    claim = Claim("entries", Rise("b", "c", 2), Rise("a", "b", 1), "it saturates")
    of = msgspec.structs.replace(study(claim), settings=lambda scale: made)
    noise = {name: 1e-6 * k for name, k in zip("abc", (0, 1, 5), strict=True)}
    given = {
        case_name(name, s): Score({"entries": v + s**2 * noise[name]}, {})
        for name, v in zip("abc", (0.1, b, c), strict=True)
        for s in FULL.seeds
    }
    found = concluded(of, FULL, given)
    assert found.claims[0].answer == answer and "the rise of DSSIM" in found.claims[0].sentence
    assert found.claims[0].difference.spread.mean == pytest.approx((c - b) / 2 - (b - 0.1), abs=1e-4)


@pytest.mark.parametrize("a, answer", [(0.1, "agrees"), (0.9, "disagrees")])
def test_a_guess_is_compared_seed_by_seed(a, answer):
    """The guess scores .5, and each seed's own difference counts."""
    given = {
        name: Score(s.values, {"entries": 0.5 + 0.2 * s.values["entries"]})
        for name, s in scores(FULL, a=a, b=0.3).items()
    }
    found = concluded(study(Claim("entries", "a", Guess("a"), "a is predicted better than by a guess")), FULL, given)
    (tested,) = found.claims
    assert tested.answer == answer and "in “a” against a guess" in tested.sentence
    assert tested.difference.spread.mean == pytest.approx(0.8 * (a + 0.002) - 0.5)
    assert (
        msgspec.convert(msgspec.to_builtins(found, str_keys=True), type(found), str_keys=True) == found
    )  # as table.json has it


def test_a_claim_about_a_measure_without_a_null_is_left_out():
    given = {name: Score(s.values) for name, s in scores(FULL, a=0.1, b=0.3).items()}
    assert not concluded(study(Claim("entries", "a", Guess("a"), "…")), FULL, given).claims


def test_an_answer_in_part_says_of_how_many():
    """a < b is shown for the one measure; of the other there is nothing to see."""
    given = {
        name: Score(s.values | {"roughness": 0.2 + 0.01 * (k % 2)}, s.nulls)
        for k, (name, s) in enumerate(scores(FULL, a=0.1, b=0.2).items())
    }
    found = concluded(study(CLAIM, Claim("roughness", "a", "b", "…")), FULL, given)
    assert answer_to_the_paper(found) == "agrees in part: 1 of 2 claims are shown"
    assert (
        answer_to_the_paper(concluded(study(Claim("roughness", "a", "b", "…")), FULL, given))
        == "no difference is shown"
    )


def test_a_quick_study_concludes_nothing_and_says_so():
    found = concluded(study(CLAIM), QUICK, scores(QUICK, a=0.1, b=0.9))
    assert "no conclusion" in paragraph(found) and "not tested" in paragraph(found)
    assert answer_to_the_paper(found).startswith("not tested") and ": shown" not in paragraph(found)


def test_a_claim_whose_measure_a_setting_lacks_is_left_out():
    assert not concluded(study(Claim("unobserved", "a", "b", "…")), FULL, scores(FULL, a=0.1, b=0.2)).claims


def test_the_table_has_a_line_for_each_setting_and_measure():
    lines = csv_text(concluded(study(CLAIM), FULL, scores(FULL, a=0.1, b=0.2))).splitlines()
    assert (
        len(lines) == 3
        and lines[0].startswith("study,scale,setting")
        and lines[1].startswith("toy,full,a,a,entries,1,5,0.102,")
    )
