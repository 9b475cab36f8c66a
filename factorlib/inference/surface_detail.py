"""Surface detail: turns of normals and factors on albedo, chosen with their stiffness by photos that had no part in them.

start      materials and lights are fitted on few cells, with the shadows and bounces of the given meshes.  Lights are far away: where normals are wrong, near
           ones take up what turns should explain (rough set of seed 0: 3.5 instead of 3.1 degrees)
stiffness  of each of `TURNS`, from stiff to soft, turns are found from all photos but those of one fold, for every fold in turn; a photo of that fold then
           gets a light of its own, with the materials given.  The stiffness is used with which the photos are likeliest, lights integrated out
           (`factorlib.inference.likelihood`); the search ends where that falls.  Every light has cells of its own (`factorlib.inference.start`):
           were they the same, normals could turn toward their centres in all photos at once
whether    turns are kept where the likelihood is higher than without turns, and the photos' held-out observations are explained better by more than `FOR`
           standard errors over clusters (`factorlib.inference.evidence`).  Of several meshes, those stay with which alone neither is better
paint      factors on the diffuse reflectance likewise, of a stiffness of `FACTORS`, beside the turns and over what these explain; they are kept where the
           likelihood is higher by more than `FOR` standard errors over photos, and held-out observations are explained better too.  The likelihood is the
           finer measure.  Of turns it takes too many: a light that is fitted makes up for a wrong normal, but not for dirt
rounds     turns from all lights, materials and lights fitted again, `ROUNDS` times
surface    at last the displacement whose normals come nearest to the turned ones: what no displacement explains (a wrong pose turns all normals
           of a photo) is left out
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import block_diag, csr_array

from factorlib.inference.evidence import AGAINST, FOR, Losses, compare, losses_of
from factorlib.inference.fit import Fit, Schedule, fitted, likelihood_of, sure_ones
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import TRIAL, TRIAL_CELLS, effects_chosen
from factorlib.inference.optimizer import light_descended
from factorlib.inference.options import Choices
from factorlib.inference.problem import JointProblem
from factorlib.inference.start import Beginning, Start, on_cells
from factorlib.inference.surface_turns import Attached, Detail, Part, Stiffness, no_detail, part_of, step
from factorlib.light.prior import LightPrior, read_light_prior
from factorlib.meshes.fine import Fine
from factorlib.results.materials import Decision

TURNS = (1000.0, 300.0, 100.0, 30.0)  # stiffness of turns: a of `factorlib.inference.surface_turns`; b is a share of it
FACTORS = (300.0, 100.0, 30.0, 10.0)  # of log factors
ROUNDS = 3
# cells of a light; folds of photos
CELLS = 250
FOLDS = 4
OBSERVATIONS = 1000  # of a light, or of a photo that judges, that materials and lights are fitted to
SETTLE = Schedule(lights=2, together=(3, 2), estimate=False)
BETWEEN = Schedule(together=(2,), estimate=False)
OWN_LIGHT = 2  # factorisations


class Surfaces(msgspec.Struct, frozen=True):
    """The meshes of a set by name, subdivided, in the order in which their nodes are numbered."""

    meshes: dict[str, Fine]

    @property
    def first(self) -> dict[str, int]:
        """The number of each mesh's first node."""
        counts = [mesh.nodes for mesh in self.meshes.values()]
        return dict(zip(self.meshes, np.cumsum([0, *counts[:-1]]).tolist()))

    @property
    def nodes(self) -> int:
        """The number of all nodes."""
        return sum(mesh.nodes for mesh in self.meshes.values())

    def laplacian(self) -> csr_array:
        """Return the Laplacian of all meshes, [v, v]."""
        return csr_array(block_diag([mesh.laplacian() for mesh in self.meshes.values()]))

    def displacements(
        self, turn: Float[np.ndarray, "v 3"], attached: Sequence[Attached]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Return by mesh, in its extents, what `Fine.displacement` finds for the turns of its nodes, as far as observations are attached to them."""
        weight = sum(np.bincount(of.node.reshape(-1), of.share.reshape(-1), self.nodes) for of in attached)
        turns = self.by_mesh(turn)
        seen = self.by_mesh(np.minimum(weight, 1.0))
        return {name: mesh.displacement(turns[name], seen[name]) for name, mesh in self.meshes.items()}

    def by_mesh(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return what belongs to each mesh's nodes."""
        return {name: values[k : k + self.meshes[name].nodes] for name, k in self.first.items()}

    def turns_of(self, displacements: dict[str, Float[np.ndarray, " n"]]) -> Float[np.ndarray, "v 3"]:
        """The turns that displacements mean; a mesh without any stays."""
        still = {name: np.zeros((mesh.nodes, 3)) for name, mesh in self.meshes.items()}
        moved = {name: self.meshes[name].turn_of(of) for name, of in displacements.items()}
        return np.vstack(list((still | moved).values()))

    def nodes_of(self, names: Iterable[str]) -> Bool[np.ndarray, " v"]:
        """Return which nodes are of these meshes."""
        return np.concatenate([np.full(mesh.nodes, name in names) for name, mesh in self.meshes.items()])


class Found(msgspec.Struct, frozen=True):
    """The answer for all meshes of a set.

    beginning of a solve: the fit on few cells, to the meshes as they are
    evidence  whether surfaces are moved, by held-out observations of photos that had no part in that;  painted: whether reflectance has detail, likewise
    stiffness that was best;  gains: by photo, of all that is kept: how much −2 log marginal likelihood fell while the photo had no part in it
    displacements  by mesh, at nodes, in extents; none where surfaces stay;  log_factors: by mesh, likewise
    """

    beginning: Beginning
    evidence: Decision
    painted: Decision = Decision(False)
    stiffness: Stiffness = Stiffness(None)
    gains: dict[str, float] = {}
    displacements: dict[str, Float[np.ndarray, " n"]] = {}
    log_factors: dict[str, Float[np.ndarray, " n"]] = {}


Report = Callable[[float, str], None]  # the share that is done, and what is being done
Tick = Callable[..., None]  # called when a piece of work is done


class Judged(msgspec.Struct, frozen=True):
    """What each photo says: −2 log marginal likelihood and held-out losses, with detail in which it had no part."""

    values: Float[np.ndarray, " f"]
    losses: Losses

    def gain_over(self, other: Judged) -> float:
        """Return by how many standard errors over photos the values are less."""
        gains = other.values - self.values
        return float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-12))


def evidence_of(after: Judged, before: Judged, held_out: float, likelihood: float) -> Decision:
    """Return whether detail is kept: better by more than so many standard errors in each of the two measures."""
    evidence = compare(before.losses, after.losses, held_out)
    return msgspec.structs.replace(evidence, kept=evidence.kept and after.gain_over(before) > likelihood)


class Trial(msgspec.Struct, frozen=True):
    """A problem without detail, its fit, and what its blocks are attached to."""

    problem: JointProblem
    fit: Fit
    surfaces: Surfaces
    attached: list[Attached]
    prior: LightPrior

    def on(self, detail: Detail) -> JointProblem:
        """The problem on a surface with detail."""
        pairs = zip(self.problem.blocks, self.attached, strict=True)
        return self.problem.of([detail.on(block, at) for block, at in pairs])

    def parts(self, detail: Detail, fit: Fit) -> list[Part]:
        """Every light linearised on a surface with detail."""
        each = zip(self.on(detail).illuminations(fit.point), fit.hyperparameters, self.attached, strict=True)
        nodes = self.surfaces.nodes
        return list(self.problem.spread(lambda one: part_of(one[0], one[1], self.prior, one[2], nodes), list(each)))

    def moving(self, detail: Detail, meshes: set[str]) -> Detail:
        """The detail with the turns of these meshes alone."""
        turn = np.where(self.surfaces.nodes_of(meshes)[:, None], detail.turn, 0.0)
        return msgspec.structs.replace(detail, turn=turn)

    @property
    def photos(self) -> list[tuple[int, int]]:
        """Each photo that has observations: its block and its number there."""
        return [(k, int(j)) for k, block in enumerate(self.problem.blocks) for j in np.unique(block.photo)]

    @property
    def names(self) -> list[str]:
        """The names of these photos."""
        return [self.problem.blocks[k].photos[j] for k, j in self.photos]

    def judged(self, details: Sequence[Detail], tick: Tick = lambda: None, plain: Judged | None = None) -> Judged:
        """Judge every photo by itself, on the surface that `details` has for it, in a light of its own, with the materials given.

        plain: what photos say without detail, which is taken over where detail turns no normal of a photo;  tick: called after each
        """

        def alone(of: tuple[int, tuple[int, int], Detail]) -> tuple[float, Losses]:
            """One photo's value and losses."""
            at, (k, number), detail = of
            own = self.problem.blocks[k].photo == number
            here = self.attached[k].take(own)
            if plain is not None and not (np.any(detail.turn[here.node]) or np.any(detail.log_factor[here.node])):
                tick()
                return plain.values[at], Losses([plain.losses.values[at]], [plain.losses.clusters[at]])
            seen = msgspec.structs.replace(self.problem.blocks[k].take(own), row=np.arange(own.sum()))
            seen = seen.sampled(OBSERVATIONS, 0)
            assert seen.row is not None
            problem = self.problem.of([detail.on(seen, here.take(seen.row))])
            begun = Point(self.fit.point.materials, [self.fit.point.lights[k]])
            (one,) = problem.fitted().illuminations(begun)
            likelihood = likelihood_of(one, self.fit.hyperparameters[k], self.prior, materials_given=True)
            likelihood, system = light_descended(likelihood, OWN_LIGHT)
            losses = losses_of(problem, Point(begun.materials, [likelihood.light]))
            tick()
            return likelihood.marginal(system), losses

        each = [(at, *pair) for at, pair in enumerate(zip(self.photos, details, strict=True))]
        values, losses = zip(*self.problem.spread(alone, each), strict=True)
        return Judged(np.array(values), Losses(*([of[i][0] for of in losses] for i in (0, 1))))

    def left_out(self, parts: list[Part], laplacian: csr_array, stiffness: Stiffness, tick: Tick) -> list[Detail]:
        """Find for every photo a surface that it had no part in: photos fall into at most `FOLDS` folds, and each takes that of the others.

        parts: of the mesh itself;  tick: called after each fold
        """
        photos = self.photos
        folds = min(FOLDS, len(self.photos))

        def others(fold: int) -> Detail:
            """Return the detail that the photos of one fold have no part in."""
            gone = [
                np.isin(block.photo, [j for at, j in photos[fold::folds] if at == k])
                for k, block in enumerate(self.problem.blocks)
            ]
            rest = [part.without(rows) if rows.any() else part for part, rows in zip(parts, gone, strict=True)]
            rest = [part for part in rest if len(part.residual)]
            found = step(rest, laplacian, stiffness, no_detail(self.surfaces.nodes))
            seen = [of.take(~rows) for of, rows in zip(self.attached, gone, strict=True)]
            moved = self.surfaces.displacements(found.turn, seen)
            tick()
            return Detail(self.surfaces.turns_of(moved), found.log_factor)

        by_fold = list(self.problem.spread(others, range(folds)))
        return [by_fold[number % folds] for number in range(len(photos))]


class Best(NamedTuple):
    """The likeliest of several stiffnesses: the surface of each photo, what photos say of it, and whether it is kept."""

    stiffness: Stiffness
    details: list[Detail]
    judged: Judged
    evidence: Decision


class Search(msgspec.Struct, frozen=True):
    """The search for detail of a trial; parts: of the mesh itself;  plain: what photos say without detail."""

    trial: Trial
    parts: list[Part]
    laplacian: csr_array
    plain: Judged
    tick: Tick

    def best(self, tried: Sequence[Stiffness], before: Judged, held_out: float, likelihood: float) -> Best:
        """Return the likeliest stiffness, from stiff to soft until one is less likely than the one before, or the first is clearly against.

        before: what photos say without it;  held_out, likelihood: by how many standard errors it must be better, in each of the two measures
        """
        found: Best | None = None
        for one in tried:
            details = self.trial.left_out(self.parts, self.laplacian, one, self.tick)
            judged = self.trial.judged(details, self.tick, self.plain)
            if found is not None and round(float(judged.values.sum() - found.judged.values.sum()), 3) >= 0:
                break
            found = Best(one, details, judged, evidence_of(judged, before, held_out, likelihood))
            if judged.gain_over(before) < AGAINST:
                break
        assert found is not None
        return found

    def turned(self) -> tuple[Best, set[str]]:
        """Return the likeliest turns, and the meshes that they move: those that are better when they are turned alone."""
        trial = self.trial
        plain = self.plain
        turned = self.best([Stiffness(a) for a in TURNS], plain, FOR, 0.0)
        moving = self.meshes_that_gain(turned.details) if turned.judged.gain_over(plain) > 0 else set()
        if 0 < len(moving) < len(trial.surfaces.meshes):
            judged = trial.judged([trial.moving(of, moving) for of in turned.details], self.tick, plain)
            turned = turned._replace(judged=judged, evidence=evidence_of(judged, plain, FOR, 0.0))
        return turned, moving

    def of_all_photos(self, stiffness: Stiffness, moving: set[str], pieces: Pieces, seed: int) -> Detail:
        """Return the detail that all photos ask for, materials and lights fitted again between its steps."""
        trial = self.trial
        parts = self.parts
        fit = self.trial.fit
        nodes = trial.surfaces.nodes_of(moving)
        detail = no_detail(trial.surfaces.nodes)
        for number in range(ROUNDS):
            begin = 0.85 + 0.05 * number
            tick = pieces.of(begin, begin + 0.05, BETWEEN.points, f"all photos, round {number + 1}")
            if number:
                fit = fitted(trial.on(detail).sampled(OBSERVATIONS, seed), fit, trial.prior, BETWEEN, tick)
                parts = trial.parts(detail, fit)
            detail = step(parts, self.laplacian, stiffness, detail, nodes)
        return detail

    def meshes_that_gain(self, turned: Sequence[Detail]) -> set[str]:
        """Return the meshes that are better when they are turned alone."""
        names = self.trial.surfaces.meshes
        if len(names) == 1:
            return set(names)
        moving = [(name, [self.trial.moving(of, {name}) for of in turned]) for name in names]
        judged = {name: self.trial.judged(details, self.tick, self.plain) for name, details in moving}
        return {name for name, one in judged.items() if evidence_of(one, self.plain, 0.0, 0.0).kept}


def found(
    problem: JointProblem,
    surfaces: Surfaces,
    attached: list[Attached],
    start: Start,
    seed: int = 0,
    report: Report = lambda share, what: None,
) -> Found:
    """Return the detail of the meshes, if photos that had no part in it gain.

    problem: all observations;  attached: where each block's lie;  start: where materials and lights begin;  seed: of what is drawn
    """
    pieces = Pieces(report)
    plain = no_detail(surfaces.nodes)
    tick = pieces.of(0.0, 0.3, TRIAL.points + SETTLE.points, "materials and lights")
    trial, begun = trial_of(problem, start, seed, (surfaces, attached), tick)
    photos = len(trial.photos)
    if photos < 2 or problem.none_held_out:
        return Found(begun, Decision(False))
    tick = pieces.of(0.3, 0.85, 4 * len(TURNS) * photos, "left-out photos")
    given = trial.judged([plain] * photos, tick)
    search = Search(trial, trial.parts(plain, trial.fit), surfaces.laplacian(), given, tick)
    turned, moving = search.turned()
    kept = turned if turned.evidence.kept else Best(Stiffness(None), [plain] * photos, given, turned.evidence)
    painted = search.best([Stiffness(kept.stiffness.turn, a) for a in FACTORS], kept.judged, 0.0, FOR)
    kept = painted if painted.evidence.kept else kept
    if not (turned.evidence.kept or painted.evidence.kept):
        return Found(begun, turned.evidence, painted.evidence)
    gains = dict(zip(trial.names, (given.values - kept.judged.values).tolist(), strict=True))
    detail = search.of_all_photos(kept.stiffness, moving, pieces, seed)
    displacements = surfaces.displacements(detail.turn, attached) if turned.evidence.kept else {}
    displacements = {name: of for name, of in displacements.items() if name in moving}
    factors = surfaces.by_mesh(detail.log_factor) if painted.evidence.kept else {}
    return Found(begun, turned.evidence, painted.evidence, kept.stiffness, gains, displacements, factors)


def trial_of(
    problem: JointProblem, start: Start, seed: int, surface: tuple[Surfaces, list[Attached]], tick: Tick
) -> tuple[Trial, Beginning]:
    """Return the problem without detail and its fit with the shadows and bounces of the given meshes, and the fit on few cells.

    surface: and where the problem's blocks lie on it
    """
    prior = read_light_prior()
    sure = sure_ones(problem)

    def fitting(name: str, some: JointProblem, begun: Fit, schedule: Schedule) -> Fit:
        """Fit under the prior."""
        return fitted(some, begun, prior, schedule, tick)

    choices = Choices(self_shadowing="on", interreflection="on", seed=seed)
    effects = effects_chosen(sure, start(sure, TRIAL_CELLS), choices, fitting)
    problem = effects.of(problem)
    fit = fitted(problem.sampled(OBSERVATIONS, seed), on_cells(effects.fit, CELLS, problem), prior, SETTLE, tick)
    return Trial(problem, fit, *surface, prior), Beginning.of(effects.fit, problem.blocks)


class Pieces(msgspec.Struct, frozen=True):
    """The report of a search, in pieces of work."""

    report: Report

    def of(self, begin: float, end: float, number: int, what: str) -> Tick:
        """Return what reports, whenever it is called, that one more of so many pieces of work is done."""
        self.report(begin, what)
        done = count(1)
        return lambda *_: self.report(begin + (end - begin) * min(next(done) / number, 1.0), what)
