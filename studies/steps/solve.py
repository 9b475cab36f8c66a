"""The stage `solve` itself on a case: writes into <case>/ what that stage writes, and seconds.json.

seconds.json holds the processor seconds of the solve, of all threads, from observations as they lie on disk to materials and lights as
they lie there: a measurement, so the one file that differs from run to run.  What was solved to start from does not count in it; that
solution lies in <case>/earlier/.  For cases that another method is to solve, seconds.json alone is written.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from factorlib.dataset.schema import LightSlice
from factorlib.jsonfile import write_json
from factorlib.model.loss import Loss
from factorlib.reflection.network import SHIPPED
from factorlib.solve import fit
from factorlib.solve.few_lobes import rounds
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import read_observations
from stages import solve
from stages.solve import Params

BEYOND_ALL = 1e3  # σ: with more, √(1 + r²/k²) − 1 would lose its digits


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """With the parameters that the case names, from nothing or from the solution of all photos but the last."""
    case, urm, home, start = inputs.facts["dataset.case"], inputs["observe"] / inputs.photo, out / inputs.photo, {}
    home.mkdir()
    if case.get("method", "ours") != "ours":
        return write_json(home / "seconds.json", 0.0)
    given, how = {**msgspec.to_builtins(params), **case["solve"]}, case.get("objects") or {}
    if how.get("start") == "earlier":
        (home / "earlier").mkdir()
        inputs = msgspec.structs.replace(inputs, unfinished=None)  # the two solves must not resume each other's
        solved(given, urm / "earlier", inputs, home / "earlier", progress)
        start = {"start": home / "earlier"}
    began = time.process_time()
    with robust_loss(how.get("robust", True)):
        solved(given, urm, inputs, home, progress, **start)
    return write_json(home / "seconds.json", round(time.process_time() - began, 2))


def solved(given: dict[str, Any], urm: Path, inputs: Inputs, out: Path, progress: Progress, **folders: Path) -> None:
    """Solve the observations in the folder `urm`, each photo in a light of its own; given: parameters of the stage."""
    files = sorted(urm.glob("*.parquet"))
    lights = {file.stem: msgspec.to_builtins(LightSlice(file.stem, None)) for file in files}
    facts = {"dataset.materials": list(read_observations(files[0]).materials), "dataset.light": lights}
    folders |= {"urm": urm, "train": SHIPPED}
    handed = Inputs(folders, facts, map=inputs.map, unfinished=inputs.unfinished)
    solve.main(msgspec.convert(given, Params), handed, out, progress)


@contextmanager
def robust_loss(kept: bool) -> Iterator[None]:
    """The solve within this process with its robust loss, or with least squares in its place.

    There is no such switch for users, for nobody should want to do without.  The scale of the few lobes' loss is at least
    `LEAST_ROBUST_SCALE` σ of the noise model; where that is so large that no residual reaches it, the loss is that of least squares.
    The default solver has a robust loss of its own, with the same consequence.
    """
    before = rounds.LEAST_ROBUST_SCALE, fit.ROBUST
    if not kept:
        rounds.LEAST_ROBUST_SCALE, fit.ROBUST = BEYOND_ALL, Loss(BEYOND_ALL)
    try:
        yield
    finally:
        rounds.LEAST_ROBUST_SCALE, fit.ROBUST = before
