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
from stages.solve import Params
from studies.catalogue import comparison, cost, hard_cases, leave_one_out, network_evaluation, parts, seeds_and_machines
from studies.catalogue.paper_sets import patterns
from studies.catalogue.structure import PATTERNS
from studies.conclusion import MEASURES
from studies.measured.align import RIGHT, WRONG
from studies.run import STUDIES, sets_of, studies
from studies.scenes import hard_cases as solve_cases
from studies.scenes import operators as operator_cases
from studies.steps.parts import CHANGES
from studies.study import FULL, QUICK, Case, Objects, light_name, settings_of


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
        steps, project = study.steps or (name.replace("-", "_"),), studies(name=name)
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
def test_patterns_have_every_material_and_light_and_are_the_seeds(pattern):
    for n, seed in ((3, 0), (5, 0), *((5, seed) for seed in range(1, 30))):
        entries = PATTERNS[pattern](n, seed)
        assert {m for m, _ in entries} == {li for _, li in entries} == set(range(n))
        assert (
            len(set(entries)) == len(entries) == {"full": n * n, "loop": 2 * n, "diagonal": n}.get(pattern, 2 * n - 1)
        )
        assert entries == PATTERNS[pattern](n, seed)


def test_docksta_is_linked_by_one_material():
    for name, components in (("docksta", 1), ("docksta-unlinked", 6)):
        case = Case(0, tuple(patterns(FULL)[name]), 10, objects=Objects(10))
        names = {light_name(li): case.names_in(li) for li in case.lights}
        assert len(set(connected_components(names).values())) == components and len(case.lights) == 6


def test_methods_see_the_same_photos():
    plain = [msgspec.structs.replace(case, method="ours") for case in comparison.STUDY.cases(QUICK).values()]
    assert len(plain) == 5 and all(case == plain[0] for case in plain)
    assert all(case.size % case.pixels == 0 for case in (plain[0], comparison.case(FULL, 0, "mitsuba")))


def test_every_shell_is_in_another_photo_too_and_keys_have_what_photos_contain():
    """Else nothing would tell its material once it is left out."""
    cases = leave_one_out.STUDY.cases(FULL).values()
    assert all(case.shells == leave_one_out.SHELLS[case.photo] for case in cases) and len(cases) == 3 * 6
    assert leave_one_out.case(QUICK, 1, "flat").shells == ("yellow",)
    facts = sets_of(leave_one_out.STUDY, QUICK)
    assert facts["photos"] == ("kitchen", "hall") and "photos/hall.jpg" in facts["content"]


def test_options_of_parts_are_options():
    for _, _, change, how in parts.WITHOUT.values():
        assert change in CHANGES and msgspec.convert(how, Params)


def test_hard_cases_are_those_of_the_tests_and_instructions_those_that_every_run_fixes():
    names = {"operator": operator_cases.CASES, "solve": solve_cases.CASES, "align": (*RIGHT, *WRONG)}
    assert hard_cases.CASES == {table: tuple(cases) for table, cases in names.items()}
    of = seeds_and_machines.INSTRUCTIONS
    assert of["fixed"] == VARIABLES and not of["all"] and of["least"].keys() == VARIABLES.keys()


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
