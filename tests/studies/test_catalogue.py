"""The studies: settings, claims, cases and steps fit together; what those measure that are measured in their own module."""

import subprocess
import sys

import msgspec
import numpy as np
import pytest
import yaml

from factorlib.arithmetic import VARIABLES
from factorlib.evaluate.gauge import connected_components
from factorlib.runner.closure import Sources
from factorlib.runner.filehash import FileHashes
from factorlib.runner.project import LIBRARY
from factorlib.solve.few_lobes.options import FewLobes
from studies.catalogue import comparison, cost, hard_cases, leave_one_out, network_evaluation, parts, seeds_and_machines
from studies.catalogue.paper_sets import patterns
from studies.catalogue.structure import PATTERNS, random
from studies.conclusion import MEASURES
from studies.measured.align import RIGHT, WRONG
from studies.run import STUDIES, sets_of, studies
from studies.scenes import hard_cases as solve_cases
from studies.scenes import operators as operator_cases
from studies.splits import CHANGES
from studies.study import FULL, QUICK, Case, Objects, light_name

SCALES = pytest.mark.parametrize("scale", [FULL, QUICK], ids=["full", "quick"])
EVERY = pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))


@SCALES
@EVERY
def test_a_study_names_what_there_is(study, scale):
    names = [setting.name for setting in study.settings(scale)]
    assert len(set(names)) == len(names) and set(study.measures) | {study.across} <= MEASURES.keys() | {""}
    assert not any(set(name) - set("abcdefghijklmnopqrstuvwxyz0123456789-") for name in names)
    for claim in study.claims(scale):
        assert set(claim.settings) <= set(names) and claim.lower != claim.higher and claim.measure in MEASURES
    cases = study.cases(scale).values()
    assert len(cases) == len(names) * len(study.numbers(scale)) == len({msgspec.json.encode(case) for case in cases})
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
    for name, study in STUDIES.items():
        steps, project = study.steps or (study.module,), studies(name=name)
        for k, step in enumerate(steps):
            assert sources.closure(project.package, step, project.pipeline_file).modules
            assert {each for each in stages[step]["inputs"] if "." not in each} <= set(steps[:k])
        assert stages[steps[-1]]["gather"] == "scores.json"
        used |= set(steps)
    assert used == stages.keys()


def test_plans_of_all_studies_need_no_science():
    code = (
        "import sys; from studies.run import STUDIES; from studies.study import FULL\n"
        "[s.cases(FULL) for s in STUDIES.values()]; heavy = {'numpy', 'torch', 'scipy'} & set(sys.modules); sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ── settings ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("n", [3, 5])
def test_patterns_have_every_material_and_light(pattern, n):
    entries = PATTERNS[pattern](n, 0)
    assert {m for m, _ in entries} == {li for _, li in entries} == set(range(n)) and len(set(entries)) == len(entries)
    assert len(entries) == {"full": n * n, "loop": 2 * n, "diagonal": n}.get(pattern, 2 * n - 1)


def test_random_patterns_differ_between_seeds_and_not_between_runs():
    assert random(5, 0) == random(5, 0) != random(5, 1)
    for seed in range(50):
        assert {m for m, _ in random(5, seed)} == {li for _, li in random(5, seed)} == set(range(5))


def test_docksta_is_linked_by_one_material():
    docksta, unlinked = (patterns(FULL)[name] for name in ("docksta", "docksta-unlinked"))
    assert (
        len(docksta) == 12 and {m for m, _ in docksta} == set(range(7)) and {li for _, li in docksta} == set(range(6))
    )
    for entries, components in ((docksta, 1), (unlinked, 6)):
        case = Case(0, tuple(entries), 10, objects=Objects(10))
        names = {light_name(li): case.names_in(li) for li in case.lights}
        assert len(set(connected_components(names).values())) == components


def test_methods_see_the_same_photos_and_full_studies_larger_ones():
    plain = [msgspec.structs.replace(case, method="ours") for case in comparison.STUDY.cases(QUICK).values()]
    assert len(plain) == 5 and all(case == plain[0] for case in plain)
    full = comparison.case(FULL, 0, "mitsuba")
    assert plain[0].size < full.size and plain[0].steps < full.steps
    assert full.size % full.pixels == plain[0].size % plain[0].pixels == 0


def test_the_rate_is_not_chosen_on_a_seed_that_is_reported():
    with pytest.raises(SystemExit, match="seed 0 is reported"):
        comparison.try_rates(seed=0)


def test_every_shell_is_in_another_photo_too_and_intervals_are_over_photos():
    """Else nothing would tell its material once it is left out."""
    study, photos = leave_one_out.STUDY, tuple(leave_one_out.SHELLS)
    cases = study.cases(FULL).values()
    assert all(case.shells == leave_one_out.SHELLS[case.photo] for case in cases) and {c.photo for c in cases} == set(
        photos
    )
    assert study.numbers(FULL) == tuple(range(6)) and len(cases) == 3 * 6
    assert leave_one_out.case(("kitchen", "hall"), 1, "flat").shells == ("yellow",)


def test_keys_have_what_photos_contain_and_neither_truth_nor_places():
    facts = sets_of(leave_one_out.STUDY, QUICK)
    assert facts["photos"] == ("kitchen", "hall") and facts["folder"] == "data/eames"
    assert "photos/hall.jpg" in facts["content"]
    assert not any(name.startswith(("truth", "/")) for name in facts["content"])


def test_options_of_parts_are_options():
    known = {*FewLobes.__struct_fields__, "robust_scale", "seen", "shadows", "bounces"}
    for _, _, how in parts.WITHOUT.values():
        assert how.keys() <= known and how.get("seen", "sure") in CHANGES


def test_hard_cases_are_those_of_the_benchmarks():
    names = {"operator": operator_cases.CASES, "solve": solve_cases.CASES, "align": (*RIGHT, *WRONG)}
    assert hard_cases.CASES == {table: tuple(cases) for table, cases in names.items()}


def test_instructions_name_the_variables_that_every_run_fixes():
    of = seeds_and_machines.INSTRUCTIONS
    assert of["fixed"] == VARIABLES and not of["all"] and of["least"].keys() == VARIABLES.keys()
    assert all(of["least"][name] != VARIABLES[name] for name in VARIABLES if name != "MKL_CBWR")
    assert seeds_and_machines.hash_of_data() == seeds_and_machines.hash_of_data()


# ── measurements ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_cost_is_of_a_process_of_its_own_and_grows_with_the_work():
    few = {"lobes": 2, "insert": 2, "rounds": 1, "iterations": 1, "polish": 0, "settle": 0}
    ballast = np.ones(40_000_000)  # 320 MB here are none there
    small = cost.cost_of({"seed": 0, "side": 1, "solve": few})
    large = cost.cost_of({"seed": 0, "side": 3, "solve": few | {"iterations": 4, "polish": 4}})
    assert 0 < small["seconds"] < large["seconds"] and 0 <= small["grown"] <= small["peak"] < 1 + ballast.nbytes / 1e9
    assert small["peak"] < cost.peak_bytes() / 1e9
    with pytest.raises(subprocess.CalledProcessError):
        cost.cost_of({"seed": 0, "side": 1, "solve": {"lobes": 0}})


def test_the_network_is_nearer_than_the_closed_form_and_both_beat_the_null():
    network, closed = (network_evaluation.score_of(3, name, 0.3, 0.5, 64) for name in ("network", "closed_form"))
    assert network.values["error_median"] < closed.values["error_median"] < 0.2
    assert network.values["rendering"] < closed.values["rendering"] < closed.nulls["rendering"]
    assert network.values["microseconds"] > 0
