"""Seeds and machines: the stages as the pipeline has them, and what the study says of differences."""

import yaml

from factorlib.arithmetic import VARIABLES
from factorlib.runner.project import LIBRARY
from studies.core.machine import SET, Machine, hash_of_data
from studies.core.pipeline import STEPS
from studies.core.table import Cell, Conclusion, Row, Spread
from studies.steps.machine.conclude import notes

ROUGHNESS = "materials.worst_roughness"


def test_steps_are_those_of_the_pipeline():
    """Slices, fan-out and gathered files are said twice; this is what keeps them equal."""
    stages = yaml.safe_load((LIBRARY / "pipeline.yaml").read_text(encoding="utf-8"))["stages"]
    order = list(STEPS)
    for name, step in STEPS.items():
        said = stages[name]
        assert step.slices == tuple(
            each.removeprefix("dataset.") for each in said["inputs"] if each.startswith("dataset.")
        )
        assert step.over_photos == (said.get("over") == "photo") and step.gather == said.get("gather")
        before = {each for each in said["inputs"] if not each.startswith("dataset.")} - {"train"}
        assert before <= set(order[: order.index(name)])


def test_instructions_name_the_variables_that_every_run_fixes():
    assert SET["fixed"] == VARIABLES and not SET["all"] and SET["least"].keys() == VARIABLES.keys()
    assert all(SET["least"][name] != VARIABLES[name] for name in VARIABLES if name != "MKL_CBWR")


def test_the_case_changes_with_the_data():
    assert Machine(0, "fixed", hash_of_data()) == Machine(0, "fixed", hash_of_data()) and len(hash_of_data()) == 16


def rows(**values):
    return [Row(name, name, 0, {ROUGHNESS: Cell(Spread(0.0, 2), dict(enumerate(of)))}) for name, of in values.items()]


def test_notes_give_the_spread_over_all_seeds_and_what_instructions_change():
    found = Conclusion(
        "x",
        "x",
        "?",
        "p",
        "v",
        "full",
        "",
        (0, 1),
        (ROUGHNESS,),
        rows(**{"fixed-0": (0.01, 0.02), "fixed-5": (0.03, 0.04), "all-0": (0.01, 0.02), "least-0": (0.01, 0.025)}),
        [],
    )
    spread, same, other = notes(found)
    assert "0.025 on average over 4 seeds" in spread and "0.01 to 0.04" in spread
    assert same == "all-0: every number is the same to the last digit."
    assert other == "least-0: numbers of the same seed differ at most so: roughness, worst material by 0.005."
