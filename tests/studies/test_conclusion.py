"""A conclusion stands only where seeds leave no doubt; numbers here are made up.  Tables and pages of it."""

import json

import msgspec
import numpy as np
import pytest

from studies.conclusion import Conclusion, conclude, difference, paragraph
from studies.run import studies
from studies.run.tables import conclusions
from studies.study import FULL, QUICK, Claim, Score, Setting, Study, case_name


def by_seed(*values):
    return dict(enumerate(values))


# ── statistics ───────────────────────────────────────────────────────────────────────────────────────────────────────


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
        *((by_seed(*[0.1 + 1e-9 * k for k in range(n)]), by_seed(*[0.9] * n), 1, "too few seeds") for n in (1, 4)),
    ],
)
def test_a_difference_is_shown_where_seeds_leave_no_doubt(first, second, comparisons, verdict):
    assert difference(first, second, comparisons)[1] == verdict


# ── claims ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def study(*claims, names="ab"):
    made = [Setting(name, name, lambda seed: QUICK.case(seed, [(0, 0)])) for name in names]
    words = {"title": "Toy <&>", "question": "Which?", "paper": "a is better.", "varied": "letter"}
    return Study(name="toy", **words, measures=("entries", "roughness"), settings=lambda s: made, claims=claims)


def scores(scale, **values):
    """Of each setting, .001 more with each seed; a guess scores .5, and a fifth of what the setting does."""
    return {
        case_name(n, s): Score({"entries": v + 0.001 * s, "roughness": 0.1}, {"entries": 0.5 + 0.2 * (v + 0.001 * s)})
        for n, v in values.items()
        for s in scale.seeds
    }


CLAIM, OTHER = Claim("entries", "a", "b", "a is better than b"), Claim("roughness", "a", "b", "…")


@pytest.mark.parametrize(
    "a, b, answer, words",
    [
        (0.1, 0.2, "agrees", ": shown ("),
        (0.2, 0.1, "disagrees", "the opposite is shown"),
        (0.1, 0.1, "no difference is shown", "no difference is shown"),
    ],
)
def test_the_sentence_says_what_was_found(a, b, answer, words):
    table = conclude(study(CLAIM), FULL, scores(FULL, a=a, b=b))
    assert words in paragraph(table) and table.answer == answer
    assert msgspec.convert(json.loads(msgspec.json.encode(table)), Conclusion, str_keys=True) == table


def test_an_answer_in_part_says_of_how_many_and_a_quick_study_concludes_nothing():
    given = scores(FULL, a=0.1, b=0.2)
    answers = [conclude(study(*of), FULL, given).answer for of in ((CLAIM, OTHER), (OTHER,), ())]
    nothing = "the paper claims nothing that is tested here"
    assert answers == ["agrees in part: 1 of 2 claims is shown", "no difference is shown", nothing]
    table = conclude(study(CLAIM), QUICK, scores(QUICK, a=0.1, b=0.9))
    assert "no conclusion" in paragraph(table) and table.answer.startswith("not tested") and not table.claims


def test_a_table_of_another_version_is_left_out_and_named(tmp_path, capsys):
    project = studies(QUICK, tmp_path)
    (project.build / "parts").mkdir(parents=True)
    (project.build / "parts" / "table.json").write_text('{"study": "parts", "rows": 1}')
    assert conclusions(project) == {} and "make study STUDY=parts" in capsys.readouterr().out
