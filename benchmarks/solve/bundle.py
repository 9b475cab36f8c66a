"""The solver of few lobes on a set: operators, lobe limits and reductions of the observations.

Time starts before the observations are reduced.  Points over time are the accepted ones of
every round and of the polish; they are scored after the solve, off the clock.
"""

from __future__ import annotations

from functools import partial

import msgspec

from benchmarks.solve.clock import Clock, Taken
from benchmarks.solve.scores import EVERY, Answer, answer_of, material_scores, picture_scores, pictures_of
from benchmarks.solve.sets import SphereSet
from benchmarks.solve.workers import threaded
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.reflection.operator import Operator
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.rounds import from_nothing
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.history import Event
from factorlib.urm.merge import merge
from factorlib.urm.observations import concatenate

JUDGE = "network"


class Variant(msgspec.Struct, frozen=True):
    """What differs from the solver's defaults; `lobes` and `sample` are per illumination."""

    operator: str = "network"
    merge_degrees: float = 2.0
    lobes: int = FewLobes().lobes
    sample: int = FewLobes().sample

    @property
    def name(self) -> str:
        default = Variant()
        fields = [f for f in self.__struct_fields__ if getattr(self, f) != getattr(default, f)]
        return "few lobes" + "".join(f", {f.replace('_degrees', '')} {getattr(self, f)}" for f in fields)


DEFAULT = Variant()
VARIANTS = (
    DEFAULT,
    Variant(operator="closed_form"),
    Variant(lobes=16),
    Variant(lobes=32),
    Variant(lobes=48),
    Variant(merge_degrees=0.0),
    Variant(merge_degrees=4.0),
    Variant(sample=700),
    Variant(sample=4000),
)


class Snapshot(msgspec.Struct, frozen=True):
    """An answer on the way, and when it was there."""

    taken: Taken
    stage: str
    lobes: int
    answer: Answer


def snapshots(spheres: SphereSet, variant: Variant, without: frozenset = frozenset()) -> list[Snapshot]:
    """The answers of one solve, the last one being the result."""
    operator = reflection_operator(variant.operator)
    seen = spheres.observations(without)
    photos = [seen.take(seen.photo == k) for k in range(len(seen.photos))]  # as they lie on disk
    clock, found = Clock(), []
    merged = concatenate(threaded(partial(merge, degrees=variant.merge_degrees), photos))
    blocks = blocks_of_observations(merged, Noise())

    def keep(event: Event, point: Point) -> None:
        answer = answer_of(blocks, point.materials, point.lights)
        found.append(Snapshot(clock.taken(), f"{event.phase} {event.round}", event.lobes, answer))

    options = FewLobes(lobes=variant.lobes, sample=variant.sample)
    problem = JointProblem(blocks, operator, spread=threaded)
    result = few_lobes(problem, from_nothing(len(seen.materials)), Run(options, snapshot=keep)).point
    answer = answer_of(blocks, result.materials, result.lights)
    return [*found, Snapshot(clock.taken(), "result", sum(map(len, result.lights)), answer)]


def run(spheres: SphereSet, variant: Variant, relight: bool) -> dict:
    """Every point scored by the judge on every 37th pixel, the result on all; with `relight`, pairs that were held back."""
    judge, found = reflection_operator(JUDGE), snapshots(spheres, variant)
    row = result_scores(spheres, found[-1].answer, variant.operator) | {"points": points(spheres, found, judge)}
    row["lobes"] = {name: len(light) for name, light in found[-1].answer.lights.items()}
    if relight and spheres.held_back():
        row["relighting"] = relighting(spheres, snapshots(spheres, variant, spheres.held_back())[-1].answer)
    return row


def points(spheres: SphereSet, found: list[Snapshot], judge: Operator) -> list[dict]:
    rows = []
    for snapshot in thinned(found):
        scores = picture_scores(pictures_of(snapshot.answer, spheres, judge, EVERY), spheres, EVERY)
        kept = {"mean_db": scores["psnr"]["mean"], "worst_db": scores["psnr"]["worst"]}
        errors = material_scores(snapshot.answer.materials, spheres)
        kept |= {kind: errors[kind]["mean"] for kind in ("diffuse", "specular", "roughness")}
        rows.append({"stage": snapshot.stage, "lobes": snapshot.lobes, **msgspec.to_builtins(snapshot.taken), **kept})
    return rows


def thinned(found: list[Snapshot], most: int = 60) -> list[Snapshot]:
    """At most that many, the last among them."""
    step = -(-len(found) // most)
    return found[::-1][::step][::-1]


def result_scores(spheres: SphereSet, answer: Answer, operator: str) -> dict:
    """All pixels by the judge, some by the operator that solved, and the materials."""
    own = picture_scores(pictures_of(answer, spheres, reflection_operator(operator), EVERY), spheres, EVERY)["psnr"]
    everywhere = picture_scores(pictures_of(answer, spheres, reflection_operator(JUDGE)), spheres)
    return {"resynthesis": everywhere | {"own": own}, "materials": material_scores(answer.materials, spheres)}


def relighting(spheres: SphereSet, answer: Answer) -> dict:
    """Pairs that the solve was not shown, nothing scaled."""
    hidden = pictures_of(answer, spheres, reflection_operator(JUDGE), only=spheres.held_back())
    return picture_scores(hidden, spheres) | {"materials": material_scores(answer.materials, spheres)}
