"""The studies: settings, claims, cases and steps fit together; what those measure that are measured in their own module."""

import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest
import yaml

from factorlib.runner.closure import Sources
from factorlib.runner.project import LIBRARY
from factorlib.runner.store import FileHashes
from stages.solve import Params
from studies.catalogue import STUDIES, methods
from studies.conclusion import MEASURES, Conclusion, conclude, difference, paragraph
from studies.run import studies
from studies.steps.parts import CHANGES
from studies.study import FULL, QUICK, Claim, Score, Setting, Study, case_name, settings_of


@pytest.mark.parametrize("scale", [FULL, QUICK], ids=["full", "quick"])
@pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))
def test_a_study_names_what_there_is(study, scale):
    names = [setting.name for setting in study.settings(scale)]
    assert len(set(names)) == len(names) and set(study.measures) <= MEASURES.keys()
    assert not any(set(name) - set("abcdefghijklmnopqrstuvwxyz0123456789-") for name in names)
    for claim in study.claims if scale is FULL else ():
        compared = {name for side in (claim.lower, claim.higher) for name in settings_of(side)}
        assert compared <= set(names) and claim.lower != claim.higher and claim.measure in MEASURES
    cases = study.cases(scale).values()
    assert len(cases) == len(names) * len(scale.seeds) == len({msgspec.json.encode(case) for case in cases})
    lights = [li for case in cases for li in getattr(case, "lights", [])]
    assert max(lights, default=0) < study.worlds(scale).lights, "worlds have no such light"


def test_equal_names_are_equal_cases_in_all_studies():
    """So that what two studies share is solved once."""
    for scale in (FULL, QUICK):
        known = {}
        for name, case in (pair for study in STUDIES.values() for pair in study.cases(scale).items()):
            assert known.setdefault(name, case) == case


def test_every_step_has_a_module_and_takes_what_was_made_before_it():
    stages = yaml.safe_load(studies().pipeline_file.read_text())["stages"]
    sources, used = Sources([LIBRARY], FileHashes(None)), set()
    project = studies()
    for steps in (study.steps for study in STUDIES.values()):
        for k, step in enumerate(steps):
            assert sources.closure(project.package, step, project.pipeline_file).record
            assert {each for each in stages[step]["inputs"] if "." not in each} <= set(steps[:k])
        assert stages[steps[-1]]["gather"] == "scores.json"
        used |= set(steps)
    assert used == stages.keys()


def test_a_plan_of_studies_loads_no_science():
    code = "import sys; from studies.catalogue import STUDIES; from studies.study import FULL; [s.cases(FULL) for s in STUDIES.values()]"
    code += "; sys.exit(', '.join({'numpy', 'torch', 'scipy', 'OpenImageIO', 'PIL'} & set(sys.modules)) or 0)"
    assert subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, check=False).returncode == 0


# ── settings ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_options_of_parts_are_options():
    for _, _, change, how in methods.WITHOUT.values():
        assert change in CHANGES and msgspec.convert(how, Params)


# ── Conclusions stand only where seeds leave no doubt; numbers here are made up ──────────


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
    table = conclude(study(CLAIM), FULL, scores(FULL, a=a, b=b))
    assert words in paragraph(table) and table.answer == answer
    assert msgspec.convert(json.loads(msgspec.json.encode(table)), Conclusion, str_keys=True) == table
