"""The studies: settings, claims, cases and steps fit together; what those measure that are measured in their own module."""

import subprocess
import sys

import msgspec
import pytest
import yaml

from factorlib.runner.closure import Sources
from factorlib.runner.project import LIBRARY
from factorlib.runner.store import FileHashes
from stages.solve import Params
from studies.catalogue import STUDIES, methods
from studies.conclusion import MEASURES
from studies.run import studies
from studies.steps.parts import CHANGES
from studies.study import FULL, QUICK, settings_of


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
