"""Which materials have a specular part: those without which held-out observations are explained worse.

The specular part of a material that is Lambertian in truth would fit errors of normals and lights.  So each material in turn, the
least specular first, is made Lambertian for a trial, the rest of the problem is brought near its optimum again, and held-out observations decide.
A material that reflects more specularly than diffusely is not tried: where normals are wrong, a blurred highlight explains held-out
observations better than the true one, and a dark glossy material would lose all that it reflects.

A trial whose iterations raise the held-out loss decides nothing.  A lobe may then have grown in a part of the light that only held-out
observations mirror, and their loss says nothing about the specular part.

A trial fits only the `LIGHTS` lights that show most of the material, so that its cost does not grow with the set; so does the fit that
it is compared with once another material has lost its specular part since the last fit of all lights.  These are fitted again at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Int

from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.evidence import Evidence
from factorlib.solve.few_lobes.descent import Descent, descend, evaluate
from factorlib.solve.few_lobes.unknowns import specular_unknowns

# Without its specular part, the held-out loss of a material that needs it is higher by more than GAIN, or that of all observations that are
# compared by more than HARM.  The latter moves by some 3 % as a descent goes on: less says nothing.
GAIN, HARM = 0.03, 0.05
NEEDED_EARLY = (
    1.3  # times the held-out loss: if it is higher after a few iterations without a specular part, that part is needed
)
FIRST, ITERATIONS = 3, 6  # iterations of a trial, and further ones where the first do not decide
LIGHTS = 8


class Specular(msgspec.Struct, frozen=True):
    """A point without needless specular parts, which materials are Lambertian, and the evidence for every material."""

    point: Point
    lambertian: Bool[np.ndarray, " m"]
    evidence: list[Evidence]


class Trials:
    """Fits of a problem near their optimum, all from the lights of one point.

    problem: its loss judges;  robust: the loss that is lowered
    """

    def __init__(self, problem: JointProblem, start: Point, robust: Loss):
        self.problem, self.start = problem, start
        self.fitting = problem.with_loss(robust)
        count = len(start.materials)
        self.observations = np.array([np.bincount(block.material, minlength=count) for block in problem.blocks])

    def near_optimum(
        self, lights: Sequence[int], materials: Materials, lambertian: Bool[np.ndarray, " m"], most: float = np.inf
    ) -> Point:
        """The point of `materials` and `lights` after some iterations; the point before them if they raise the held-out loss.

        most: if the held-out loss exceeds it after the `FIRST` iterations, no more are made
        """
        own, judge, fixed = (
            self.fitting.restricted(lights),
            self.problem.restricted(lights),
            specular_unknowns(lambertian),
        )
        before = evaluate(own, Point(materials, self.start.restricted(lights).lights))
        after = descend(own, before, Descent(FIRST), fixed=fixed)
        if not (np.isfinite(most) and judge.held_out_loss(after.point) > most):
            after = descend(own, after, Descent(ITERATIONS), fixed=fixed)
        harmless = (1 + HARM) * judge.held_out_loss(before.point)
        return after.point if judge.held_out_loss(after.point) <= harmless else before.point

    def lights_of(self, m: int) -> Int[np.ndarray, " k"]:
        """The lights that show most of material m."""
        count = self.observations[:, m]
        most = np.sort(np.argsort(-count, kind="stable")[:LIGHTS])
        return most[count[most] > 0]

    def shows_held_out(self, lights: Sequence[int], m: int) -> bool:
        """Whether any observation of material m in the lights is held out."""
        blocks = [self.problem.blocks[k] for k in lights]
        return any((block.held_out & (block.material == m)).any() for block in blocks)


def without_needless_specular(
    problem: JointProblem,
    start: Point,
    robust: Loss,
    report: Callable[[int, float], None] = lambda trial, held_out: None,
) -> Specular:
    """The point with needless specular parts gone, which materials have none, and the evidence for every material.

    start: nearly at an optimum, so that iterations change the held-out loss less than what is decided;  robust: the loss to lower;
    report: called with the number of each trial, from 0, and the held-out loss that it is compared with
    """
    trials, lambertian = Trials(problem, start, robust), np.zeros(len(start.materials), bool)
    every, numbers = np.arange(len(problem.blocks)), np.arange(len(lambertian))
    base = start.materials  # all go on from here by as many iterations
    chosen, evidence = trials.near_optimum(every, base, lambertian), [Evidence(True) for _ in lambertian]
    current = True  # whether `chosen` is the fit of `base`
    for number, m in enumerate(np.argsort(base.specular.mean(1), kind="stable")):
        lights = trials.lights_of(m)
        if not trials.shows_held_out(lights, m) or base.specular[m].mean() > base.diffuse[m].mean():
            continue
        richer = chosen.restricted(lights) if current else trials.near_optimum(lights, base, lambertian)
        judge, without = problem.restricted(lights), base.lambertian(m)
        report(number, held_out := judge.held_out_loss(richer))
        most = NEEDED_EARLY * held_out
        trial = trials.near_optimum(lights, without, lambertian | (numbers == m), most)
        evidence[m] = compare(judge, trial, richer, int(m))
        if evidence[m].kept:
            continue
        base, lambertian[m] = without, True
        current = len(lights) == len(every)
        chosen = trial if current else chosen
    return Specular(chosen if current else trials.near_optimum(every, base, lambertian), lambertian, evidence)


def compare(problem: JointProblem, without: Point, richer: Point, material: int) -> Evidence:
    """Whether the specular part of a material is kept, by the held-out losses of two points at (or near) their optimum."""
    losses = [np.concatenate(problem.held_out_losses(point)) for point in (without, richer)]
    own = np.concatenate([b.material[b.held_out | problem.none_held_out] for b in problem.blocks]) == material
    harmed = losses[0].mean() > (1 + HARM) * losses[1].mean()
    plain, full = (float(of[own].mean()) if own.any() else 0.0 for of in losses)
    return Evidence(bool(plain > (1 + GAIN) * full or harmed), full, plain)
