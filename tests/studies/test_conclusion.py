"""A conclusion stands only where seeds leave no doubt; numbers here are made up.  Tables, figures and pages of it."""

import json
import xml.etree.ElementTree as tree

import msgspec
import numpy as np
import pytest
from scipy.stats import ttest_1samp

from studies.catalogue import cost, leave_one_out, seeds_and_machines
from studies.conclusion import (  # fmt: skip
    NO_CONCLUSION,
    Cell,
    Conclusion,
    Row,
    best,
    concluded,
    csv_text,
    difference,
    paragraph,
    spread,
)
from studies.figures import figure
from studies.run.page import against_the_paper, is_full, page
from studies.study import FULL, QUICK, Claim, Guess, Rise, Score, Setting, Study, case_name


def by_seed(*values):
    return dict(enumerate(values))


# ── statistics ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_interval_of_a_mean_is_that_of_the_t_test():
    values = [0.3, 0.5, 0.45, 0.6, 0.35]
    s, expected = spread(values), ttest_1samp(values, 0).confidence_interval(0.95)
    assert (s.low, s.high) == pytest.approx(tuple(expected))
    assert s.mean == pytest.approx(0.44) and s.deviation == pytest.approx(np.std(values, ddof=1))
    assert spread([1.0]).low is spread([1.0]).deviation is None, "one seed has no interval"


WORSE, SAME, NONE = by_seed(1.0, 11.0, 5.0, 7.0, 3.0), by_seed(*[0.1] * 5), by_seed(*[0.0] * 5)
# .1 better in each seed, among seeds that differ by 10; t = 3 on 4 degrees of freedom: beyond 2.78 for one comparison, below 4.6 for five
BETTER = {seed: value - 0.1 - 0.001 * seed for seed, value in WORSE.items()}
THREE = np.array([1.0, -1.0, 0.0, 0.5, -0.5])
THREE = by_seed(*(-THREE / THREE.std(ddof=1) * 5**0.5 - 3))


@pytest.mark.parametrize(
    "first, second, comparisons, verdict",
    [
        (BETTER, WORSE, 1, "lower"),
        (WORSE, BETTER, 1, "higher"),
        (by_seed(0.1, 0.2, 0.3, 0.2, 0.1), by_seed(0.2, 0.1, 0.2, 0.3, 0.12), 1, "not shown"),
        (SAME, SAME, 1, "not shown"),
        (THREE, NONE, 1, "lower"),
        (THREE, NONE, 5, "not shown"),
        *((by_seed(*[0.1 + 1e-9 * k for k in range(n)]), by_seed(*[0.9] * n), 1, "too few seeds") for n in range(1, 5)),
    ],
)
def test_a_difference_is_shown_where_seeds_leave_no_doubt(first, second, comparisons, verdict):
    assert difference(first, second, comparisons).verdict == verdict


def test_only_seeds_that_both_have_are_compared():
    with pytest.raises(ValueError, match="no seed"):
        difference({0: 1.0}, {1: 1.0})
    assert difference({0: 1.0, 1: 2.0}, {1: 1.0, 2: 3.0}).spread.mean == 1.0


# ── claims ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def study(*claims, names="ab"):
    made = [Setting(name, name, lambda seed: QUICK.case(seed, [(0, 0)])) for name in names]
    return Study(
        "toy",
        "Toy <&>",
        "Which?",
        "a is better.",
        "letter",
        ("entries", "roughness"),
        lambda s: made,
        lambda s: list(claims),
    )


def scores(scale, **values):
    """Of each setting, .001 more with each seed; a guess scores .5."""
    return {
        case_name(n, s): Score({"entries": v + 0.001 * s}, {"entries": 0.5})
        for n, v in values.items()
        for s in scale.seeds
    }


CLAIM = Claim("entries", "a", "b", "a is better than b")
OTHER = Claim("roughness", "a", "b", "…")


@pytest.mark.parametrize(
    "a, b, answer, words",
    [
        (0.1, 0.2, "agrees", ": shown ("),
        (0.2, 0.1, "disagrees", "the opposite is shown"),
        (0.1, 0.1, "no difference is shown", "no difference is shown"),
    ],
)
def test_the_sentence_says_what_was_found(a, b, answer, words):
    table = concluded(study(CLAIM), FULL, scores(FULL, a=a, b=b))
    assert words in paragraph(table) and table.answer == answer
    assert table.rows[0].cells["entries"].null == 0.5 and "roughness" not in table.rows[0].cells
    assert len(csv_text(table).splitlines()) == 3 and csv_text(table).splitlines()[1].startswith(
        "toy,full,a,a,entries,1,5,"
    )
    assert msgspec.convert(json.loads(msgspec.json.encode(table)), Conclusion, str_keys=True) == table


@pytest.mark.parametrize("b, c, answer", [(0.5, 0.6, "agrees"), (0.5, 1.9, "disagrees")])
def test_rises_are_compared_per_unit(b, c, answer):
    """From a to b one unit, from b to c two: .4 and .05 or .7 a unit."""
    claim, values = Claim("entries", Rise("b", "c", 2), Rise("a", "b", 1), "it saturates"), {"a": 0.1, "b": b, "c": c}
    noise = {"a": 0, "b": 1e-6, "c": 5e-6}
    given = {case_name(n, s): Score({"entries": v + s**2 * noise[n]}) for n, v in values.items() for s in FULL.seeds}
    (tested,) = concluded(study(claim, names="abc"), FULL, given).claims
    assert tested.answer == answer and "the rise of DSSIM" in tested.sentence
    assert tested.difference.spread.mean == pytest.approx((c - b) / 2 - (b - 0.1), abs=1e-4)


@pytest.mark.parametrize("a, answer", [(0.1, "agrees"), (0.9, "disagrees")])
def test_a_guess_is_compared_seed_by_seed(a, answer):
    given = {
        n: Score(s.values, {"entries": 0.5 + 0.2 * s.values["entries"]}) for n, s in scores(FULL, a=a, b=0.3).items()
    }
    (tested,) = concluded(study(Claim("entries", "a", Guess("a"), "a beats a guess")), FULL, given).claims
    assert tested.answer == answer and "in “a” against a guess" in tested.sentence
    assert tested.difference.spread.mean == pytest.approx(0.8 * (a + 0.002) - 0.5)


@pytest.mark.parametrize("claim", [Claim("entries", "a", Guess("a"), "…"), Claim("unobserved", "a", "b", "…")])
def test_a_claim_about_what_a_setting_lacks_is_left_out(claim):
    given = {name: Score(s.values) for name, s in scores(FULL, a=0.1, b=0.2).items()}
    assert not concluded(study(claim), FULL, given).claims


def test_an_answer_in_part_says_of_how_many_and_one_that_is_no_claim_goes_before():
    """a < b is shown for the one measure; of the other there is nothing to see."""
    given = {
        name: Score(s.values | {"roughness": 0.2 + 0.01 * (k % 2)}, s.nulls)
        for k, (name, s) in enumerate(scores(FULL, a=0.1, b=0.2).items())
    }
    both = concluded(study(CLAIM, OTHER), FULL, given)
    assert both.answer == "agrees in part: 1 of 2 claims are shown"
    assert concluded(study(OTHER), FULL, given).answer == "no difference is shown"
    assert concluded(study(), FULL, given).answer == "the paper claims nothing that is tested here"
    assert msgspec.structs.replace(both, own_answer="disagrees: more").answer == "disagrees: more"


def test_a_quick_study_concludes_nothing_and_says_so():
    table = concluded(study(CLAIM), QUICK, scores(QUICK, a=0.1, b=0.9))
    assert "no conclusion" in paragraph(table) and "not tested" in paragraph(table)
    assert table.answer.startswith("not tested") and ": shown" not in paragraph(table)
    assert msgspec.structs.replace(table, own_answer="agrees").answer.startswith("not tested")


# ── notes, figures, pages ────────────────────────────────────────────────────────────────────────────────────────────


def made(rows, measures=("entries", "seconds"), scale="full", label=""):
    """A table of values by seed; rows: by label, the values of each measure."""
    table = {n: {m: Cell(spread(v), by_seed(*v)) for m, v in zip(measures, of, strict=False)} for n, of in rows.items()}
    seeds = tuple(range(len(next(iter(rows.values()))[0])))
    return Conclusion(
        "x", "Title <&>", "?", "p", "v", scale, label, seeds, measures, [Row(n, n, c) for n, c in table.items()], []
    )


def steps(*starts):
    return {
        f"s{k}": ([k + v + 0.01 * s for s in range(5)], [2 * k + 1.0 + s for s in range(5)])
        for k, v in enumerate(starts)
    }


def test_the_best_is_named_with_those_that_are_not_shown_to_be_worse():
    noisy = {name: (np.random.default_rng(k).normal(size=5),) for k, name in enumerate("ab")}
    assert (
        best(made(steps(1, 1)), "entries")
        == "Least mean of DSSIM, all entries: “s0”; all others are shown to be worse."
    )
    assert "not shown to be worse: “" in best(made(noisy), "entries")
    assert "too few seeds" in best(made({"a": ([1.0],), "b": ([2.0],)}), "entries")


@pytest.mark.parametrize("power, word", [(1.0, "linear"), (1.4, "more than linear"), (0.5, "less than linear")])
def test_an_exponent_has_an_interval(power, word):
    rng = np.random.default_rng(0)
    costs = {n: by_seed(*(0.1 * n**power * np.exp(0.02 * rng.normal(size=5)))) for n in (9, 100, 1600)}
    e = cost.exponents(costs, range(5))
    assert e.low < power < e.high and e.high - e.low < 0.05 and cost.called(e) == word
    assert cost.called(cost.exponents({9: {0: 1.0}, 25: {0: 2.0}}, [0])) == "not decided"


def test_notes_give_photos_seeds_and_instructions_one_by_one():
    table = made({"left out": ([0.1, 0.2],), "flat": ([0.15, 0.123],)}, ("chair",), "quick")
    assert leave_one_out.by_photo(table) == [
        "DSSIM of a chair, photo by photo (left out, flat): kitchen 0.1, 0.15; hall 0.2, 0.12."
    ]
    runs = {"fixed-0": [0.01, 0.02], "fixed-5": [0.03, 0.04], "all-0": [0.01, 0.02], "least-0": [0.01, 0.025]}
    apart, same, other = seeds_and_machines.notes(
        made({n: (v,) for n, v in runs.items()}, ("materials.worst_roughness",))
    )
    assert "0.025 on average over 4 seeds" in apart and "0.01 to 0.04" in apart
    assert same == "all-0: every number is the same to the last digit."
    assert other == "least-0: numbers of the same seed differ at most so: roughness, worst material by 0.005."


@pytest.mark.parametrize("across", ["", "seconds"])
def test_figures_stand_alone_and_show_every_setting(across):
    table = made(steps(0, 1, 100))
    root = tree.fromstring(figure(table, across))
    words = "\n".join(e.text or "" for e in root.iter())
    assert sum(e.tag.endswith("circle") for e in root.iter()) >= len(table.rows) and "Title <&>" in words
    assert all(row.label in words for row in table.rows)


@pytest.mark.parametrize("names, axes", [(("few", "more"), 1), (("a: few", "a: more"), 1), (("a: few", "b: more"), 2)])
def test_settings_share_an_axis_unless_they_are_of_several_kinds(names, axes):
    rows = {name: ([1.0, 2.0],) for name in names}
    assert figure(made(rows, ("peak",))).count("largest memory of the process (GB)") == axes


@pytest.mark.parametrize("change", [{"measures": ["entries", "gone"]}, {"rows": 1}])
def test_the_page_names_tables_of_another_version_and_escapes_what_it_shows(tmp_path, change):
    table = json.loads(msgspec.json.encode(made(steps(0, 1))))
    for name in ("new", "old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "figure.svg").write_text("<svg></svg>")
    text = page([(table, tmp_path / "new"), (table | change, tmp_path / "old")])
    assert text.count("<section") == 1 and "not shown: old." in text and "Title &lt;&amp;&gt;" in text
    assert "of a solve (s)</th>" in text and "<th>DSSIM, all entries</th>" in text
    assert "not shown" not in page([(table, tmp_path / "new")])


def documented(label):
    head = f"what is varied ({label})" if label else "what is varied"
    answers = "| [Prior on lights](#prior-on-lights) | It falls. | agrees |\n"
    return f"<!-- begin conclusions -->\n{answers}<!-- end conclusions -->\n<!-- begin prior -->\n| {head} | error |\n<!-- end prior -->\n"


@pytest.mark.parametrize(
    "on_page, here, stays", [("", NO_CONCLUSION, True), ("", "", False), (NO_CONCLUSION, NO_CONCLUSION, False), ("", None, True)]
)  # fmt: skip
def test_what_docs_have_stays_until_there_is_a_study_as_large(on_page, here, stays):
    done = {} if here is None else {"prior": made(steps(0, 1), label=here)}
    (row,) = [
        line for line in against_the_paper(done, documented(on_page)).splitlines() if line.startswith("| [Prior on")
    ]
    assert row.endswith("| agrees |") == stays, row
    assert is_full(documented(on_page), "prior") == (not on_page) and not is_full("", "prior")
