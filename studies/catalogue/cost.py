"""Cost: how do time and memory grow with the entries of the matrix?

What is measured is no function of the inputs: it is kept until its source changes.  seconds: of the processor, of all threads between the
start of the solve and its end, which other work hardly lengthens;  peak: the largest resident set of the process;  grown: beyond that before the solve

`python -m studies.catalogue.cost <case as JSON>` measures one case, in a process of its own.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.measured.tools import apart
from studies.steps import Params
from studies.study import Scale, Score, Setting, Study, own

SIDES = {"full": (3, 5, 10, 20, 40), "quick": (3, 5)}
BY_DEFAULT = {"full": (3, 5, 10), "quick": (3,)}
SHORT = {"lobes": 6, "insert": 6, "rounds": 1, "iterations": 4, "polish": 4}
KINDS = {"": ("6 lobes", "6 lobes a light"), "default-": ("by default", "as the solver is by default")}
LINEAR = (0.9, 1.1)  # from 9 entries to 1,600 the cost is then within a factor 1.7 of proportion
STATUS = Path("/proc/self/status")


def settings(scale: Scale) -> list[Setting]:
    """By entries, with 6 lobes; then as the solver is by default."""
    sizes = [("", n, SHORT) for n in SIDES[scale.name]] + [("default-", n, {}) for n in BY_DEFAULT[scale.name]]
    return [
        Setting(f"{k}{n * n}", f"{KINDS[k][0]}, {n * n:,}", lambda seed, n=n, how=how: {"seed": seed, "side": n, "solve": how})
        for k, n, how in sizes
    ]  # fmt: skip


def exponents(costs: Mapping[float, Mapping[int, float]], seeds: Sequence[int]) -> Any:
    """The spread over seeds of the slope of log cost over log size, by least squares; costs: by size, then by seed."""
    import numpy as np

    from studies.conclusion import spread

    return spread([np.polyfit(np.log(list(costs)), np.log([of[s] for of in costs.values()]), 1)[0] for s in seeds])


def called(exponent: Any) -> str:
    """What the interval of an exponent shows: linear where it lies within `LINEAR`."""
    if exponent.low is None:
        return "not decided"
    if LINEAR[0] <= exponent.low and exponent.high <= LINEAR[1]:
        return "linear"
    return "less than linear" if exponent.high < 1 else "more than linear" if exponent.low > 1 else "not decided"


def growth(table: Any, kind: str, measure: str) -> tuple[list[int], Any]:
    """The sizes of a kind of setting and the exponent of a measure over them."""
    rows = {row.name.removeprefix(kind): row for row in table.rows if row.name.startswith(kind)}
    costs = {int(name): row.cells[measure].values for name, row in rows.items() if name.isdigit()}
    return sorted(costs), exponents(costs, table.seeds)


def notes(table: Any) -> list[str]:
    """The exponents, and what is not compared."""
    sentences = []
    for kind, measure in ((kind, measure) for kind in KINDS for measure in ("seconds", "grown")):
        sizes, e = growth(table, kind, measure)
        over = "one seed, no interval" if e.low is None else f"{e.low:.2f} to {e.high:.2f} over {e.seeds} seeds"
        what = "Processor time of the solve" if measure == "seconds" else "Memory beyond that before the solve"
        between = f"{sizes[0]:,} to {sizes[-1]:,} entries, {KINDS[kind][1]}"
        if len(sizes) > 1:
            sentences.append(f"{what} grows as entries to the power {e.mean:.2f} ({over}; {between}): {called(e)}.")
    return [*sentences, "The paper's 30 minutes are of other pictures, another machine and a GPU: no ratio is drawn."]


def answer(table: Any) -> str:
    """Of time with few lobes, against the paper's linear."""
    word = called(growth(table, "", "seconds")[1])
    return {"linear": "agrees", "not decided": word}.get(word, f"disagrees: {word}")


STUDY = Study(
    name="cost",
    title="Cost",
    question="How do time and memory grow with the entries of the matrix?",
    paper="Linear in the entries; 30 minutes for 5 × 5 on a Titan X, after 3 hours of training.",
    varied="most lobes of a light, entries of the matrix",
    measures=("seconds", "seconds_an_entry", "peak", "grown"),
    settings=settings,
    claims=(own("seconds_an_entry", "1600", "9", "an entry of 1,600 costs less than one of 9"),),
    steps=(),
    notes=notes,
    answer=answer,
)


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Measure a case: writes <case>.json."""
    write_json(out / f"{inputs.photo}.json", Score(cost_of(inputs.facts["dataset.case"])))


def cost_of(case: dict[str, Any]) -> dict[str, float]:
    """Measured in a fresh process of this interpreter.  Raises CalledProcessError where it fails; its words go to this one's."""
    return apart(__spec__.name, case)


def measured(seed: int, side: int, solve: dict[str, Any]) -> dict[str, float]:
    """In this process: `side` materials in as many lights; solve: options of the solver that differ from their defaults."""
    import msgspec

    from factorlib.model.problem import JointProblem
    from factorlib.reflection import reflection_operator
    from factorlib.solve.few_lobes.options import FewLobes, Run
    from factorlib.solve.few_lobes.solve import few_lobes
    from studies.scenes.problems import square

    operator = reflection_operator("network")
    joint = JointProblem(square(side, operator, seed), operator)
    before, start = peak_bytes(), time.process_time()
    few_lobes(joint, side, Run(msgspec.convert({**solve, "seed": seed}, FewLobes)))
    seconds, peak = time.process_time() - start, peak_bytes()
    memory = {"peak": peak / 1e9, "grown": (peak - before) / 1e9}
    return {"seconds": seconds, "seconds_an_entry": seconds / side**2, **memory}


def peak_bytes() -> int:
    """The largest resident set so far; of this program alone where Linux says so, for `getrusage` begins with that of its parent."""
    if STATUS.exists():
        line = next(line for line in STATUS.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
        return 1024 * int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    print(json.dumps(measured(**json.loads(sys.argv[1]))))
