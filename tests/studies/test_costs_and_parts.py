"""Studies of priors, costs, operators, parts and hard cases: what their cases mean, and that their scores move as they should."""

import ast
import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest

from factorlib.evaluate.ball import constant_light
from factorlib.runner.project import LIBRARY
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.urm.observations import Observations
from studies.catalogue.contents import STUDIES
from studies.core import cost, hard, part, table
from studies.core.band import Band
from studies.core.cost import Cost, Sized, cost_of
from studies.core.exponents import called, exponents
from studies.core.operators import score_of
from studies.core.study import FULL, QUICK, Claim
from studies.core.table import Cell, Conclusion, Difference, Row, Spread
from studies.core.tint import chromaticity
from studies.report.against import against
from studies.report.bars import bars
from studies.report.best import best
from studies.report.curves import curves
from studies.report.tables import answer_to_the_paper
from studies.splits import CHANGES, splits_of
from tests.scenes import hard_cases, operators

OWN = ("prior", "network-evaluation", "cost", "speed", "parts", "hard-cases")


@pytest.mark.parametrize("scale", [FULL, QUICK], ids=["full", "quick"])
@pytest.mark.parametrize("name", OWN)
def test_settings_have_names_of_their_own_and_claims_compare_them(name, scale):
    study = STUDIES[name]
    names = [setting.name for setting in study.settings(scale)]
    assert len(set(names)) == len(names) and not any(
        set(n) - set("abcdefghijklmnopqrstuvwxyz0123456789-") for n in names
    )
    assert {n for claim in study.claims(scale) for n in (claim.lower, claim.higher)} <= set(names)
    assert len({msgspec.json.encode(case) for case in study.cases(scale).values()}) == len(study.cases(scale))


def test_hard_cases_are_those_of_the_benchmarks():
    assert hard.CASES["solve"] == tuple(hard_cases.CASES)
    assert hard.CASES["operator"] == tuple(operators.CASES)
    assert hard.CASES["align"] == operator_free_kinds()


def operator_free_kinds():
    from benchmarks.align import RIGHT, WRONG

    return (*RIGHT, *WRONG)


def test_options_of_parts_are_options():
    known = {*FewLobes.__struct_fields__, "robust_scale", "seen", "shadows", "bounces"}
    for _, how in part.PARTS.values():
        assert how.keys() <= known and how.get("seen", "sure") in CHANGES


# cost -----------------------------------------------------------------------------------------------------------------


def test_a_cost_is_of_a_process_of_its_own_and_grows_with_the_work():
    few = {"lobes": 2, "insert": 2, "rounds": 1, "iterations": 1, "polish": 0, "settle": 0}
    ballast = np.ones(40_000_000)  # 320 MB here are none there
    small, large = cost_of(Sized(0, 1, few)), cost_of(Sized(0, 3, few | {"iterations": 4, "polish": 4}))
    assert 0 < small.seconds < large.seconds and small.before <= small.peak < 10**9 + ballast.nbytes
    assert small.peak < cost.peak_bytes()


def test_a_case_that_fails_is_an_error_and_no_cost():
    with pytest.raises(subprocess.CalledProcessError):
        cost_of(Sized(0, 1, {"lobes": 0}))
    assert msgspec.json.decode(b'{"seconds": 1, "before": 2, "peak": 3}', type=Cost) == Cost(1, 2, 3)


@pytest.mark.parametrize("power, word", [(1.0, "linear"), (1.4, "more than linear"), (0.5, "less than linear")])
def test_an_exponent_is_found_with_its_interval(power, word):
    rng = np.random.default_rng(0)
    costs = {n: {seed: 0.1 * n**power * np.exp(0.02 * rng.normal()) for seed in range(5)} for n in (9, 100, 1600)}
    found = exponents(costs, range(5))
    assert found.low < power < found.high and found.high - found.low < 0.05 and called(found) == word


def test_one_seed_decides_nothing():
    assert called(exponents({9: {0: 1.0}, 25: {0: 2.0}}, [0])) == "not decided"


# lights' colours ------------------------------------------------------------------------------------------------------


def test_chromaticity_is_free_of_the_factor_that_nothing_tells():
    colours = np.random.default_rng(0).lognormal(0, 0.4, (3, 3))
    found = chromaticity([constant_light(c) for c in colours])
    assert found > 0.1
    assert chromaticity([constant_light(c * [2.0, 0.3, 1.0]) for c in colours]) == pytest.approx(found, rel=1e-5)
    assert chromaticity([constant_light(k * c) for k, c in zip((1, 5, 0.2), colours)]) == pytest.approx(found, rel=1e-5)
    greyer = np.exp(0.5 * np.log(colours))
    assert chromaticity([constant_light(c) for c in greyer]) < found


# operators ------------------------------------------------------------------------------------------------------------


def test_the_network_is_nearer_than_the_closed_form_and_both_beat_the_null():
    network, closed = (score_of(Band(3, name, 0.3, 0.5, 64)) for name in ("network", "closed_form"))
    assert network.values["error_median"] < closed.values["error_median"] < 0.2
    assert network.values["rendering"] < closed.values["rendering"] < closed.nulls["rendering"]
    assert network.values["microseconds"] > 0


# parts ----------------------------------------------------------------------------------------------------------------


def photo(seed=0, n=400):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3)) * [1, 1, 0.3] - [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radiance = rng.uniform(0.1, 1, (n, 3))
    return Observations(
        normal=normal, view=np.tile([0.0, 0.0, -1.0], (n, 1)), radiance=radiance, clipped=radiance > 0.9, material=np.zeros(n, int),
        photo=np.zeros(n, int), illumination=np.zeros(n, int), x=np.arange(n), y=np.zeros(n, int), weight=rng.uniform(0.1, 1, n),
        materials=("red",), photos=("day",), illuminations=("day",), confidence=rng.uniform(0.1, 1, n),
    )  # fmt: skip


@pytest.mark.parametrize("change", [None, *CHANGES])
def test_what_is_asked_for_is_the_same_whatever_a_solve_may_see(change):
    (usual,), (found,) = splits_of([photo()], {}), splits_of([photo()], {}, change)
    np.testing.assert_array_equal(found.asked.radiance, usual.asked.radiance)
    assert len(found.seen) and not {*map(tuple, found.seen.normal)} & {*map(tuple, found.asked.normal)}
    changed = {"sure": "precision", "unclipped": "clipped", "dropped": "clipped"}.get(change)
    same = len(found.seen) == len(usual.seen) and all(
        np.array_equal(getattr(found.seen, k), getattr(usual.seen, k)) for k in ("precision", "clipped")
    )
    assert same == (changed is None)
    assert change not in ("unclipped", "dropped") or not found.seen.clipped.any()


# figures and sentences ------------------------------------------------------------------------------------------------


def conclusion(
    names=("a, 1", "a, 2", "b, 1", "b, 2"), measures=("entries", "seconds"), seeds=(0, 1, 2, 3, 4), answer=""
):
    def cell(k, m):
        values = {seed: (k + 1.0) * (m + 1) * (1 + 0.01 * seed) for seed in seeds}
        mean = float(np.mean(list(values.values())))
        return Cell(Spread(mean, len(seeds), 0.01, mean - 0.02, mean + 0.02), values)

    rows = [
        Row(f"s{k}", name, k, {measure: cell(k, m) for m, measure in enumerate(measures)})
        for k, name in enumerate(names)
    ]
    return Conclusion(
        "x", "Title <&>", "?", "p", "varied", "full", "", tuple(seeds), tuple(measures), rows, [], answer=answer
    )


@pytest.mark.parametrize(
    "draw", [curves, bars, lambda found: against(found, "seconds", ("entries",))], ids=["curves", "bars", "against"]
)
def test_figures_stand_alone_and_show_every_setting(draw):
    import xml.etree.ElementTree as tree

    found = conclusion()
    root = tree.fromstring(draw(found))
    dots = [e for e in root.iter() if e.tag.endswith("circle")]
    assert len(dots) >= len(found.rows)
    assert any("Title <&>" in (e.text or "") for e in root.iter())


@pytest.mark.parametrize(
    "names, axes", [(("few seeds", "more seeds"), 1), (("a: few", "a: more"), 1), (("a: few", "b: more"), 2)]
)
def test_settings_share_an_axis_unless_they_are_of_several_kinds(names, axes):
    assert bars(conclusion(names=names, measures=("peak",))).count("largest memory of the process (GB)") == axes


def test_the_best_is_named_with_those_that_are_not_shown_to_be_worse():
    found = conclusion(names=("one", "two"))
    assert best(found, "entries") == "Least mean of DSSIM, all entries: “one”; all others are shown to be worse."
    rng = np.random.default_rng(0)
    noisy = [
        msgspec.structs.replace(
            row,
            cells={
                "entries": msgspec.structs.replace(row.cells["entries"], values={s: rng.normal() for s in range(5)})
            },
        )
        for row in found.rows
    ]
    assert "not shown to be worse: “two”" in best(msgspec.structs.replace(found, rows=noisy), "entries")
    assert "too few seeds" in best(conclusion(names=("one", "two"), seeds=(0,)), "entries")


def test_an_answer_that_is_no_claim_is_the_answer_to_the_paper_unless_the_study_is_quick():
    claim = table.Tested(Claim("entries", "s0", "s1", "w"), Difference(Spread(0.0, 5), "lower"), "agrees", "s")
    found = msgspec.structs.replace(conclusion(answer="disagrees: more than linear"), claims=[claim])
    assert answer_to_the_paper(found) == "disagrees: more than linear"
    assert answer_to_the_paper(msgspec.structs.replace(found, answer="")) == "agrees"
    assert "not tested" in answer_to_the_paper(msgspec.structs.replace(found, label="quick"))


def test_notes_survive_the_table_and_plans_of_all_studies_need_no_science():
    found = msgspec.structs.replace(conclusion(), notes=["a note"])
    assert msgspec.convert(json.loads(msgspec.json.encode(found)), Conclusion, str_keys=True).notes == ["a note"]
    code = (
        "import sys; from studies.catalogue.contents import STUDIES; from studies.core.study import FULL\n"
        "[s.cases(FULL) for s in STUDIES.values()]; heavy = {'numpy', 'torch', 'scipy'} & set(sys.modules); sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_kind_has_the_steps_of_its_pipeline():
    import yaml

    for study in STUDIES.values():
        stages = yaml.safe_load((LIBRARY / "studies/run/pipelines" / f"{study.kind}.yaml").read_text())["stages"]
        files = {file.stem for file in (LIBRARY / "studies/steps" / study.kind).glob("*.py")} - {"__init__"}
        assert set(stages) <= files and list(stages)[-2:] == ["score", "conclude"]
        for file in files:
            ast.parse((LIBRARY / "studies/steps" / study.kind / f"{file}.py").read_text())
