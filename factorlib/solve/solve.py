"""The joint solve: one reflectance per material and one light per illumination, from all photos at once.

    effects     shadows and bounces, and tone curves, are chosen by held-out observations (`factorlib.solve.choices`)
    materials   materials and lights are fitted together, to observations whose normals are sure (`factorlib.solve.fit`)
    splitting   the cells that hold most of each light's energy split in four, while held-out observations gain: what is sharper than a cell
                looks as if materials were smoother.  Suns and lamps are cells split deep
    lights      given the materials, lights are fitted to observations of any confidence

Every part is a function of the one before it, and the journal keeps what is done.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.light.lobes import Lobes
from factorlib.light.prior import LightPrior, read_light_prior
from factorlib.model.gauge import in_gauge
from factorlib.model.lights import Light, even_cells
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.choices import FEW, STARTS, TRIAL_CELLS, Curves, Effects, curves_chosen, effects_chosen
from factorlib.solve.evidence import FINER, Evidence, compare, losses_of
from factorlib.solve.fit import Fit, Schedule, all_free, fitted, sure_ones
from factorlib.solve.history import Event, Report, Solution, unreported
from factorlib.solve.options import Choices
from factorlib.solve.resume import Journal
from factorlib.solve.start import starting_point

T = TypeVar("T")
MATERIALS = Schedule(lights=4, together=(10, 8))
AFTER_SPLITTING = Schedule(lights=2, together=(6, 4), estimate=False)
LIGHTS = Schedule(together=(0, 8, 6), least=0.1)
SPLIT = 24  # cells of a light that split at once
WORTH = 0.05  # of the held-out loss; after a splitting that gained 3 %, two more gained 3.6 and 1 % on data/eames, materials no better
SMALLEST = (
    0.5  # degrees between cells: the sun's width.  No cell splits that is less than twice as far from its neighbours
)


class Start(msgspec.Struct, frozen=True):
    """Where a solve starts: the points of which the one that explains most goes on; earlier: of an earlier solution, cells as they are."""

    points: Callable[[JointProblem, int], list[Point]]
    earlier: bool = False


class Run(msgspec.Struct, frozen=True):
    """choices: of the user;  report: called at every point that is tried;  journal: the parts that are done already;  prior: on lights."""

    choices: Choices = Choices()
    report: Report = unreported
    journal: Journal = msgspec.field(default_factory=Journal)
    prior: LightPrior = msgspec.field(default_factory=read_light_prior)


class Split(msgspec.Struct, frozen=True):
    """What splitting led to: the fit, and the evidence for each splitting."""

    fit: Fit
    evidence: list[Evidence]


def from_nothing(materials: int) -> Start:
    """Materials 0 … `materials`−1 and lights from mean radiances alone; with few materials, from several roughnesses."""

    def points(problem: JointProblem, cells: int) -> list[Point]:
        """One point, or one a roughness."""
        roughness = STARTS if materials <= FEW else STARTS[1:2]
        return [starting_point(problem.blocks, materials, cells, one) for one in roughness]

    return Start(points)


def solve(problem: JointProblem, start: Start, run: Run | None = None) -> Solution:
    """The answer, in the gauge of `factorlib.model.gauge`; problem: all observations, its loss judges those that are held out."""
    run = run or Run()
    choices, prior, told = run.choices, run.prior, Told(run)
    sure = sure_ones(problem)
    begun = start.points(sure, min(TRIAL_CELLS, choices.cells))
    effects = told.part("effects", Effects, lambda: effects_chosen(sure, begun, prior, choices, told))
    problem, sure = effects.of(problem), effects.of(sure)
    curves = told.part("tone", Curves, lambda: curves_chosen(sure, effects.fit, prior, choices, told))
    some, all_ = (of.sampled(choices.observations, choices.seed) for of in (sure, problem))
    fit = told.part("materials", Fit, lambda: _materials(some, curves.fit, start, run, told))
    split = told.part("splitting", Split, lambda: split_while_gaining(some, fit, run, told))
    lights = told.part("lights", Fit, lambda: _lights(all_, split.fit, prior, told))
    return Solution(
        in_gauge(lights.point, problem.blocks),
        told.history,
        problem.loss,
        lambertian=np.zeros(len(lights.point.materials), bool),
        shadows=effects.shadows,
        interreflection=effects.bounces,
        tone=curves.evidence,
        splitting=split.evidence,
        materials=split.fit,
        lights=lights,
    )


def _materials(problem: JointProblem, trial: Fit, start: Start, run: Run, told: Told) -> Fit:
    """Materials and lights together, from the fit of few observations."""
    first, cells = min(TRIAL_CELLS, run.choices.cells), run.choices.cells
    known = [
        start.earlier and len(light) != first for light in trial.point.lights
    ]  # an earlier solution's light keeps its cells
    lights = [light if has else on_cells(light, cells) for light, has in zip(trial.point.lights, known, strict=True)]
    begun = msgspec.structs.replace(trial, point=Point(trial.point.materials, lights))
    return told.judged(
        problem, fitted(problem, begun, run.prior, MATERIALS, all_free(begun), told("materials and lights", begun))
    )


def _lights(problem: JointProblem, fit: Fit, prior: LightPrior, told: Told) -> Fit:
    """The lights that all observations show, given the materials."""
    return told.judged(problem, fitted(problem, fit, prior, LIGHTS, ~all_free(fit), told("lights", fit)))


def split_while_gaining(problem: JointProblem, fit: Fit, run: Run, told: Told) -> Split:
    """Splitting after splitting, until there were `Choices.splittings`.  One that does not explain held-out observations better by more than
    FINER standard errors is undone and the last; one that lowers their loss by less than WORTH is kept and the last."""
    evidence, before = [], losses_of(problem, fit.point)
    for number in range(0 if problem.none_held_out else run.choices.splittings):
        lights = [light.split(brightest(light)) for light in fit.point.lights]
        begun = msgspec.structs.replace(fit, point=Point(fit.point.materials, lights))
        trial = fitted(
            problem, begun, run.prior, AFTER_SPLITTING, all_free(fit), told(f"splitting {number + 1}", begun)
        )
        told.judged(problem, trial)
        after = losses_of(problem, trial.point)
        evidence.append(compare(before, after, FINER))
        if not evidence[-1].kept:
            break
        fit, before = trial, after
        if evidence[-1].held_out_loss_without < (1 + WORTH) * evidence[-1].held_out_loss_with:
            break
    return Split(fit, evidence)


def brightest(light: Light) -> Bool[np.ndarray, " p"]:
    """The `SPLIT` cells that hold most energy, of those whose parts are no smaller than `SMALLEST`."""
    spacing = np.degrees(light.spacing)
    energy = np.where(spacing > 2 * SMALLEST, light.energy.sum(1), 0.0)
    which = np.zeros(len(light), bool)
    which[np.argsort(-energy, kind="stable")[:SPLIT]] = True
    return which & (energy > 0)


def on_cells(light: Light, count: int) -> Light:
    """Return the light on `count` cells of one size."""
    cells = even_cells(count)
    radiance = Lobes(light.axis, light.sharpness, light.weight).radiance(cells.axis)
    lobes = msgspec.structs.replace(light, axis=cells.axis, log_sharpness=np.log(cells.sharpness), weight=radiance)
    return lobes.with_log_radiance(np.log(np.maximum(radiance, 1e-12)).T)


class Happened(msgspec.Struct, frozen=True):
    """The journal keeps the events of a part in this form."""

    events: list[Event]


class Told:
    """What is done part by part: the journal keeps each part with its events, which are reported and remembered."""

    def __init__(self, run: Run):
        self.journal, self.report, self.history = run.journal, run.report, list[Event]()

    def part(self, name: str, type_: type[T], compute: Callable[[], T]) -> T:
        """The part as the journal has it, or computed now and kept; its events join the history."""
        if (kept := self.journal.kept(name, type_)) is not None:
            for event in self.journal.kept(f"{name}, events", Happened).events:
                self._happened(event)
            return kept
        before = len(self.history)
        value = compute()
        self.journal.keep(f"{name}, events", Happened(self.history[before:]))
        return self.journal.keep(name, value)

    def __call__(self, phase: str, start: Fit) -> Callable[[float], None]:
        """Return the function that a fit calls with the mean robust loss of each point."""
        number, iteration, cells = (
            (self.history[-1].round + 1 if self.history else 0),
            0,
            sum(map(len, start.point.lights)),
        )

        def tell(loss: float) -> None:
            """Report one point."""
            nonlocal iteration
            self._happened(Event(number, phase, iteration, loss, float("nan"), cells))
            iteration += 1

        return tell

    def judged(self, problem: JointProblem, fit: Fit) -> Fit:
        """The fit, whose held-out loss is reported as the end of its part (iteration −1)."""
        last = self.history[-1]
        self._happened(msgspec.structs.replace(last, iteration=-1, held_out=problem.held_out_loss(fit.point)))
        return fit

    def _happened(self, event: Event) -> None:
        self.history.append(event)
        self.report(event)
