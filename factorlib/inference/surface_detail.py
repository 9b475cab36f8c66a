"""Surface detail: normals and albedo factors, chosen with their stiffness by held-out photos.

start       Materials and lights are fitted on few cells, with the shadows and interreflection of the given meshes.
            Lights are infinitely far away: near lights absorb what turns of wrong normals should explain (rough set of
            seed 0: 3.5 instead of 3.1 degrees).
stiffness   For each of `TURNS`, from stiff to soft, and for every fold, turns are estimated from all photos outside the
            fold.  A photo of the fold then gets its own light, with the materials given.  The stiffness with the
            largest marginal likelihood of the photos is used (`factorlib.inference.likelihood`); the search ends where
            that falls.  Every light has its own cells (`factorlib.inference.start`): with common cells, normals could
            turn toward the cells' centres in all photos at once.
decision    Turns are kept under two conditions: the likelihood is higher than without them, and they explain the
            photos' held-out observations better by more than `FOR` standard errors over clusters
            (`factorlib.inference.evidence`).  Of several meshes, one stays as it is if its turns alone do not improve
            both.
paint       Factors on the diffuse reflectance are chosen likewise, with a stiffness of `FACTORS`, in addition to the
            turns.  They are kept if the likelihood is higher by more than `FOR` standard errors over photos and
            held-out observations are explained better.  The likelihood is the finer measure.  It accepts too many
            turns: a fitted light compensates for a wrong normal, but not for dirt.
rounds      Turns are estimated from all lights, and materials and lights are fitted again, `ROUNDS` times.
surface     The result is the displacement whose normals are nearest to the turned ones.  It excludes turns that no
            displacement explains: a wrong pose turns all normals of a photo.
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
from factorlib.meshes.subdivision import SubdividedMesh
from factorlib.results.materials import Decision

# Stiffness of turns: a of `factorlib.inference.surface_turns`; b is a share of it.
TURNS = (1000.0, 300.0, 100.0, 30.0)
FACTORS = (300.0, 100.0, 30.0, 10.0)  # stiffness of log factors
ROUNDS = 3
CELLS = 250  # cells of a light
FOLDS = 4  # folds of photos
OBSERVATIONS = 1000  # fitted observations of a light, or of a held-out photo
SETTLE = Schedule(lights=2, together=(3, 2), estimate=False)
BETWEEN = Schedule(together=(2,), estimate=False)
OWN_LIGHT = 2  # factorisations in the fit of a held-out photo's light


class Surfaces(msgspec.Struct, frozen=True):
    """Subdivided meshes of a set by name, in the order of their nodes' numbers."""

    meshes: dict[str, SubdividedMesh]

    @property
    def first(self) -> dict[str, int]:
        """Number of each mesh's first node."""
        counts = [mesh.nodes for mesh in self.meshes.values()]
        return dict(zip(self.meshes, np.cumsum([0, *counts[:-1]]).tolist()))

    @property
    def nodes(self) -> int:
        """Number of all nodes."""
        return sum(mesh.nodes for mesh in self.meshes.values())

    def laplacian(self) -> csr_array:
        """Return the Laplacian of all meshes, [v, v]."""
        return csr_array(block_diag([mesh.laplacian() for mesh in self.meshes.values()]))

    def displacements(
        self, turn: Float[np.ndarray, "v 3"], attached: Sequence[Attached]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the displacement of each mesh that best explains the turns of its nodes, in extents.

        Nodes count by the observations attached to them (`SubdividedMesh.displacement`).
        """
        weight = sum(np.bincount(of.node.reshape(-1), of.share.reshape(-1), self.nodes) for of in attached)
        turns = self.by_mesh(turn)
        seen = self.by_mesh(np.minimum(weight, 1.0))
        return {name: mesh.displacement(turns[name], seen[name]) for name, mesh in self.meshes.items()}

    def by_mesh(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the values of each mesh's nodes."""
        return {name: values[k : k + self.meshes[name].nodes] for name, k in self.first.items()}

    def turns_of(self, displacements: dict[str, Float[np.ndarray, " n"]]) -> Float[np.ndarray, "v 3"]:
        """Return the turns that displacements imply; a mesh without a displacement has none."""
        still = {name: np.zeros((mesh.nodes, 3)) for name, mesh in self.meshes.items()}
        moved = {name: self.meshes[name].turn_of(of) for name, of in displacements.items()}
        return np.vstack(list((still | moved).values()))

    def nodes_of(self, names: Iterable[str]) -> Bool[np.ndarray, " v"]:
        """Return a mask of the nodes of these meshes."""
        return np.concatenate([np.full(mesh.nodes, name in names) for name, mesh in self.meshes.items()])


class Found(msgspec.Struct, frozen=True):
    """Surface detail of all meshes of a set.

    Attributes:
        beginning: Fit on few cells to the meshes as they are, from which a solve starts.
        evidence: Decision on turns, by held-out observations of held-out photos.
        painted: Decision on detail of reflectance, likewise.
        stiffness: Stiffness of the chosen detail.
        gains: Decrease of −2 log marginal likelihood of each held-out photo by the kept detail.
        displacements: Displacements at the nodes of each moved mesh, in extents.
        log_factors: Log factors at the nodes of each mesh; empty if they are not kept.
    """

    beginning: Beginning
    evidence: Decision
    painted: Decision = Decision(False)
    stiffness: Stiffness = Stiffness(None)
    gains: dict[str, float] = {}
    displacements: dict[str, Float[np.ndarray, " n"]] = {}
    log_factors: dict[str, Float[np.ndarray, " n"]] = {}


Report = Callable[[float, str], None]  # completed share, and the current activity
Tick = Callable[..., None]  # called at the end of each unit of work


class Judged(msgspec.Struct, frozen=True):
    """Scores of each photo, with detail that was estimated from other photos.

    Attributes:
        values: −2 log marginal likelihood of each photo.
        losses: Held-out losses of each photo.
    """

    values: Float[np.ndarray, " f"]
    losses: Losses

    def gain_over(self, other: Judged) -> float:
        """Return the mean decrease of the values, in standard errors over photos."""
        gains = other.values - self.values
        return float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-12))


def evidence_of(after: Judged, before: Judged, held_out: float, likelihood: float) -> Decision:
    """Return the decision on detail: kept if both measures gain more than their thresholds.

    Args:
        after: Scores with the detail.
        before: Scores without it.
        held_out: Threshold of the held-out losses, in standard errors.
        likelihood: Threshold of the marginal likelihood, in standard errors.
    """
    evidence = compare(before.losses, after.losses, held_out)
    return msgspec.structs.replace(evidence, kept=evidence.kept and after.gain_over(before) > likelihood)


class Trial(msgspec.Struct, frozen=True):
    """Problem without detail, its fit, and the attachment of its blocks to the surface."""

    problem: JointProblem
    fit: Fit
    surfaces: Surfaces
    attached: list[Attached]
    prior: LightPrior

    def on(self, detail: Detail) -> JointProblem:
        """Return the problem on a surface with detail."""
        pairs = zip(self.problem.blocks, self.attached, strict=True)
        return self.problem.of([detail.on(block, at) for block, at in pairs])

    def parts(self, detail: Detail, fit: Fit) -> list[Part]:
        """Linearise every light on a surface with detail."""
        each = zip(self.on(detail).illuminations(fit.point), fit.hyperparameters, self.attached, strict=True)
        nodes = self.surfaces.nodes
        return list(self.problem.spread(lambda one: part_of(one[0], one[1], self.prior, one[2], nodes), list(each)))

    def moving(self, detail: Detail, meshes: set[str]) -> Detail:
        """Return the detail with the turns of these meshes alone."""
        turn = np.where(self.surfaces.nodes_of(meshes)[:, None], detail.turn, 0.0)
        return msgspec.structs.replace(detail, turn=turn)

    @property
    def photos(self) -> list[tuple[int, int]]:
        """Photos with observations, each as its block and its number there."""
        return [(k, int(j)) for k, block in enumerate(self.problem.blocks) for j in np.unique(block.photo)]

    @property
    def names(self) -> list[str]:
        """Names of these photos."""
        return [self.problem.blocks[k].photos[j] for k, j in self.photos]

    def judged(self, details: Sequence[Detail], tick: Tick = lambda: None, plain: Judged | None = None) -> Judged:
        """Score every photo by itself: on its own detail, in its own light, with the materials given.

        Args:
            details: Detail for each photo, estimated from other photos.
            tick: Called after each photo.
            plain: Scores without detail, used for a photo whose detail is zero; None to compute all.
        """

        def alone(of: tuple[int, tuple[int, int], Detail]) -> tuple[float, Losses]:
            """Return one photo's value and losses."""
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
        """Return a surface for every photo, estimated from other photos.

        Photos are split into at most `FOLDS` folds, and each photo gets the surface of the other folds.

        Args:
            parts: Linearised lights on the mesh itself.
            laplacian: Laplacian of all meshes.
            stiffness: Stiffness of the detail.
            tick: Called after each fold.
        """
        photos = self.photos
        folds = min(FOLDS, len(self.photos))

        def others(fold: int) -> Detail:
            """Return the detail that is estimated without the photos of one fold."""
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
    """Likeliest of several stiffnesses.

    Attributes:
        stiffness: Stiffness.
        details: Detail for each photo, estimated from other photos.
        judged: Scores of the photos.
        evidence: Decision on the detail.
    """

    stiffness: Stiffness
    details: list[Detail]
    judged: Judged
    evidence: Decision


class Search(msgspec.Struct, frozen=True):
    """Search for the surface detail of a trial.

    Attributes:
        trial: Problem and its fit.
        parts: Linearised lights on the mesh itself.
        laplacian: Laplacian of all meshes.
        plain: Scores without detail.
        tick: Called after each unit of work.
    """

    trial: Trial
    parts: list[Part]
    laplacian: csr_array
    plain: Judged
    tick: Tick

    def best(self, tried: Sequence[Stiffness], before: Judged, held_out: float, likelihood: float) -> Best:
        """Return the likeliest stiffness.

        The search goes from stiff to soft.  It ends at a stiffness that is less likely than the previous one, or
        with clear evidence against the detail.

        Args:
            tried: Stiffnesses, from stiff to soft.
            before: Scores without this detail.
            held_out: Threshold of the held-out losses, in standard errors.
            likelihood: Threshold of the marginal likelihood, in standard errors.
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
        """Return the likeliest turns, and the meshes that gain from their turns alone."""
        trial = self.trial
        plain = self.plain
        turned = self.best([Stiffness(a) for a in TURNS], plain, FOR, 0.0)
        moving = self.meshes_that_gain(turned.details) if turned.judged.gain_over(plain) > 0 else set()
        if 0 < len(moving) < len(trial.surfaces.meshes):
            judged = trial.judged([trial.moving(of, moving) for of in turned.details], self.tick, plain)
            turned = turned._replace(judged=judged, evidence=evidence_of(judged, plain, FOR, 0.0))
        return turned, moving

    def of_all_photos(self, stiffness: Stiffness, moving: set[str], pieces: Pieces, seed: int) -> Detail:
        """Return the detail from all photos, with materials and lights fitted again between its steps.

        Args:
            stiffness: Stiffness of the detail.
            moving: Meshes whose normals may turn.
            pieces: Report of progress.
            seed: Seed of the drawn observations.
        """
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
        """Return the meshes that gain from their turns alone."""
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
    """Return the detail of the meshes, if photos gain from detail that was estimated without them.

    Args:
        problem: All observations.
        surfaces: Subdivided meshes.
        attached: Attachment of each block to the surface.
        start: Maker of the initial fits.
        seed: Seed of the drawn observations.
        report: Called with the completed share and the current activity.
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
    """Return the problem without detail with its fit, and the fit on few cells.

    Shadows and interreflection are those of the given meshes.

    Args:
        problem: All observations.
        start: Maker of the initial fits.
        seed: Seed of the drawn observations.
        surface: Subdivided meshes, and the attachment of each block to them.
        tick: Called at every evaluated point.
    """
    prior = read_light_prior()
    sure = sure_ones(problem)

    def fitting(name: str, some: JointProblem, begun: Fit, schedule: Schedule) -> Fit:
        """Fit under the prior on lights."""
        return fitted(some, begun, prior, schedule, tick)

    choices = Choices(self_shadowing="on", interreflection="on", seed=seed)
    effects = effects_chosen(sure, start(sure, TRIAL_CELLS), choices, fitting)
    problem = effects.of(problem)
    fit = fitted(problem.sampled(OBSERVATIONS, seed), on_cells(effects.fit, CELLS, problem), prior, SETTLE, tick)
    return Trial(problem, fit, *surface, prior), Beginning.of(effects.fit, problem.blocks)


class Pieces(msgspec.Struct, frozen=True):
    """Report of a search, in units of work."""

    report: Report

    def of(self, begin: float, end: float, number: int, what: str) -> Tick:
        """Return a function that reports one more completed unit of work at each call.

        Args:
            begin: Share that is complete before.
            end: Share that is complete afterwards.
            number: Number of units.
            what: Activity.
        """
        self.report(begin, what)
        done = count(1)
        return lambda *_: self.report(begin + (end - begin) * min(next(done) / number, 1.0), what)
