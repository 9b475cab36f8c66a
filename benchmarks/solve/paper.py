"""The paper's solver on a set, in the same form as the solver of few lobes'; each point and the result as there.

`share` of the observations may be taken, the same of every pair: the paper's run is 5 samplings of each, so that its
time is proportional to their number, and `extrapolated` is the time divided by the share.
"""

from __future__ import annotations

import numpy as np

from benchmarks.solve.bundle import JUDGE, Snapshot, points, relighting, result_scores
from benchmarks.solve.clock import Clock
from benchmarks.solve.scores import answer_of
from benchmarks.solve.sets import SphereSet
from benchmarks.solve.workers import threaded
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.history import Event
from factorlib.solve.paper import Paper, solve
from factorlib.urm.merge import merge

OPERATORS = ("paper_network", "network")
MERGE_DEGREES = 2.0


def snapshots(spheres: SphereSet, operator: str, share: float, without: frozenset = frozenset()) -> list[Snapshot]:
    seen = spheres.observations(without)
    clock, found = Clock(), []
    merged = merge(seen, MERGE_DEGREES)
    kept = np.random.default_rng(0).random(len(merged)) < share
    blocks = blocks_of_observations(merged.take(kept), Noise(), held_out=0.0)

    def keep(event: Event, point: Point) -> None:
        answer = answer_of(blocks, point.materials, point.lights)
        found.append(Snapshot(clock.taken(), f"{event.phase} {event.iteration}", event.lobes, answer))

    problem = JointProblem(blocks, reflection_operator(operator), spread=threaded)
    solve(problem, len(seen.materials), Paper(), snapshot=keep)
    return found


def run(spheres: SphereSet, operator: str, share: float, relight: bool) -> dict:
    found = snapshots(spheres, operator, share)
    last = found[-1]
    row = result_scores(spheres, last.answer, operator) | {"points": points(spheres, found, reflection_operator(JUDGE)), "share": share}
    row["extrapolated"] = {"wall": last.taken.wall / share, "processor": last.taken.processor / share}
    if relight and spheres.held_back():
        row["relighting"] = relighting(spheres, snapshots(spheres, operator, share, spheres.held_back())[-1].answer)
    return row
