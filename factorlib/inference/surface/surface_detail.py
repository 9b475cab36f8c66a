"""Surface detail: normals and albedo factors, chosen with their stiffness by held-out photos.

start       Materials and lights are fitted on few cells, with the shadows and interreflection of the given meshes.
            Lights are then fitted on `CELLS` cells: with fewer, turned normals explain what cells blur, and exact
            surfaces in sharp lights were moved (log Bayes factors of 34 and 145 instead of −15 and −243).  Lights are
            infinitely far away: near lights absorb what turns of wrong normals should explain (rough set of seed 0: 3.5
            instead of 3.1 degrees).  Observations count by the confidence of their normals, because turns are to
            explain what wrong normals do, but not at rims and on thin parts.
stiffness   Lights are linearised once, on the mesh itself.  For each of `TURN_STIFFNESSES`, from stiff to soft, and for
            every fold, turns are estimated from all photos outside the fold.  The linearised model gives the likelihood
            of a photo of the fold in a light of its own (`LightTerms.change`).  The stiffness with the largest one is
            used; the search ends where it falls.  Every light has its own cells (`factorlib.inference.fit.start`): with
            common cells, normals could turn toward the cells' centres in all photos at once.  Of several meshes, one
            stays as it is if the log Bayes factor of its turns alone does not exceed `VERY_STRONG`.
decision    The light of each photo is fitted anew to the selected turns.  They are kept if the photos' log Bayes
            factor, summed, exceeds `VERY_STRONG`.  The held-out observations of six photos are too few: they refused
            turns with log Bayes factors of 100 to 317, by which relit pictures gain 1.0 and 3.4 dB (data/eames,
            captured set of seed 128).  Exact surfaces have negative ones.
paint       Factors on the diffuse reflectance are chosen likewise, with a stiffness of `FACTOR_STIFFNESSES`, in
            addition to the turns.  They are kept if the likelihood is higher by more than `CLEARLY_FOR` standard errors
            over photos and held-out observations are explained better.
nodes       Only nodes that two photos or more show turn.
surface     The chosen detail is estimated from all photos.  The result is the displacement whose normals are nearest to
            the turned ones.  It excludes turns that no displacement explains: a wrong pose turns all normals of a
            photo.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import count
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array

from factorlib.inference.choices.model_selection import (
    BACKGROUND_SCHEDULE,
    CLEARLY_FOR,
    TRIAL,
    TRIAL_CELLS,
    VERY_STRONG,
    Losses,
    compare_models,
    held_out_losses,
    select_backgrounds,
    select_effects,
)
from factorlib.inference.fit.fit import Fit, FitSchedule, light_likelihood, reliable_observations
from factorlib.inference.fit.fit_runner import FitRunner
from factorlib.inference.fit.optimizer import descend_light
from factorlib.inference.fit.start import InitialFit, Start, refine_cells
from factorlib.inference.model.materials import Point
from factorlib.inference.model.normal_errors import weighed_by_confidence
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.inference.surface.surface_turns import (
    Detail,
    LightTerms,
    Stiffness,
    SurfacePositions,
    Surfaces,
    linearise_light,
    solve_detail,
    zero_detail,
)
from factorlib.light.prior import LightPrior
from factorlib.results.materials import Decision
from factorlib.robust import TINY

# Stiffness of turns: a of `factorlib.inference.surface.surface_turns`; b is a share of it.
TURN_STIFFNESSES = (1000.0, 300.0, 100.0, 30.0, 10.0)
FACTOR_STIFFNESSES = (300.0, 100.0, 30.0, 10.0)  # stiffness of log factors
CELLS = 250  # cells of a light, given the materials
LIGHTS_SCHEDULE = FitSchedule(light_steps=2, descents=(2,), materials_fixed=True)
FOLDS = 4  # folds of photos
OBSERVATIONS = 600  # fitted observations of a light, or of a held-out photo
LIGHT_STEPS = 2  # factorisations in the fit of a held-out photo's light


class SurfaceEstimate(msgspec.Struct, frozen=True):
    """Surface detail of all meshes of a set.

    Attributes:
        beginning: Fit on few cells to the meshes as they are, from which a solve starts.
        evidence: Decision on turns, by the log Bayes factor of left-out photos.
        painted: Decision on log factors, by likelihood and held-out observations of left-out photos.
        stiffness: Stiffness of the chosen detail.
        gains: Decrease of −2 log marginal likelihood of each held-out photo by the kept detail.
        displacements: Displacements at the nodes of each moved mesh, in units of the mesh's extent.
        log_factors: Log factors at the nodes of each mesh; empty if they are not kept.
    """

    beginning: InitialFit
    evidence: Decision
    painted: Decision = Decision(False)
    stiffness: Stiffness = Stiffness(None)
    gains: dict[str, float] = {}
    displacements: dict[str, Float[np.ndarray, " n"]] = {}
    log_factors: dict[str, Float[np.ndarray, " n"]] = {}


ProgressReport = Callable[[float, str], None]  # completed share, and the current activity
Tick = Callable[..., None]  # called at the end of each unit of work


class PhotoScores(msgspec.Struct, frozen=True):
    """Scores of each photo, with detail that was estimated from other photos.

    Attributes:
        values: −2 log marginal likelihood of each photo.
        losses: Held-out losses of each photo.
    """

    values: Float[np.ndarray, " f"]
    losses: Losses

    def gain_over(self, reference: PhotoScores) -> float:
        """Return the mean decrease of the values, in standard errors over photos."""
        gains = reference.values - self.values
        return float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), TINY))


def decide_turns(scores: PhotoScores, reference: PhotoScores) -> Decision:
    """Return the decision on turns: kept if the log Bayes factor of the photos exceeds `VERY_STRONG`."""
    log_bayes_factor = float((reference.values - scores.values).sum()) / 2
    evidence = compare_models(reference.losses, scores.losses, 0.0)
    return msgspec.structs.replace(evidence, accepted=log_bayes_factor > VERY_STRONG, log_bayes_factor=log_bayes_factor)


def decide_paint(scores: PhotoScores, reference: PhotoScores) -> Decision:
    """Return the decision on log factors: kept if likelihood and held-out losses are better, the former clearly."""
    evidence = compare_models(reference.losses, scores.losses, 0.0)
    return msgspec.structs.replace(evidence, accepted=evidence.accepted and scores.gain_over(reference) > CLEARLY_FOR)


class DetailTrial(msgspec.Struct, frozen=True):
    """Baseline of a search for surface detail: the problem on the bare meshes, its fit, and where observations lie.

    Attributes:
        problem: Observations, without detail.
        fit: Fit to them.
        surfaces: Subdivided meshes.
        attached: Mesh nodes of each observation, by block.
        prior: Prior on lights.
    """

    problem: JointProblem
    fit: Fit
    surfaces: Surfaces
    attached: list[SurfacePositions]
    prior: LightPrior

    def with_detail(self, detail: Detail) -> JointProblem:
        """Return the problem on a surface with detail."""
        blocks = zip(self.problem.blocks, self.attached, strict=True)
        return self.problem.with_blocks([detail.apply_to(block, positions) for block, positions in blocks])

    def linearise(self, detail: Detail, fit: Fit) -> list[LightTerms]:
        """Linearise every light on a surface with detail."""
        tasks = zip(self.with_detail(detail).illuminations(fit.point), fit.hyperparameters, self.attached, strict=True)
        nodes = self.surfaces.nodes
        return list(
            self.problem.spread(lambda task: linearise_light(task[0], task[1], self.prior, task[2], nodes), list(tasks))
        )

    def restrict_turns(self, detail: Detail, meshes: set[str]) -> Detail:
        """Return the detail with turns on some meshes alone, called `meshes`."""
        turn = np.where(self.surfaces.node_mask(meshes)[:, None], detail.turn, 0.0)
        return msgspec.structs.replace(detail, turn=turn)

    @property
    def photos(self) -> list[tuple[int, int]]:
        """Photos with observations, each as the number of its block and its number in that block."""
        return [(k, int(j)) for k, block in enumerate(self.problem.blocks) for j in np.unique(block.photo)]

    @property
    def shared_nodes(self) -> Bool[np.ndarray, " v"]:
        """Mask of the nodes that two photos or more show.

        Turns that one photo alone shows would explain errors of its light and pose, and nothing contradicts them:
        normals of the only photo from behind the chair became 1.6 to 2.0 degrees worse (sets of seeds 103, 136).
        """
        nodes = self.surfaces.nodes
        count = np.zeros(nodes, int)
        for k, j in self.photos:
            positions = self.attached[k].take(self.problem.blocks[k].photo == j)
            count += np.bincount(positions.node.reshape(-1), positions.share.reshape(-1), nodes) > 0
        return count >= 2

    @property
    def names(self) -> list[str]:
        """Names of the photos with observations, in the order of `photos`."""
        return [self.problem.blocks[k].photos[j] for k, j in self.photos]

    def score_photos(
        self, details: Sequence[Detail], tick: Tick = lambda: None, plain: PhotoScores | None = None
    ) -> PhotoScores:
        """Score every photo by itself, on the detail for it, in a light that is fitted to it, with the materials fixed.

        Args:
            details: Detail for each photo, estimated from other photos.
            tick: Called after each photo.
            plain: Scores without detail, used for a photo whose detail is zero; None to compute all.
        """

        def score(task: tuple[int, tuple[int, int], Detail]) -> tuple[float, Losses]:
            """Return one photo's value and losses."""
            index, (k, number), detail = task
            rows = self.problem.blocks[k].photo == number
            positions = self.attached[k].take(rows)
            if plain is not None and not (
                np.any(detail.turn[positions.node]) or np.any(detail.log_factor[positions.node])
            ):
                tick()
                return plain.values[index], Losses([plain.losses.values[index]], [plain.losses.clusters[index]])
            photo = msgspec.structs.replace(self.problem.blocks[k].take(rows), row=np.arange(rows.sum()))
            photo = photo.subsample(OBSERVATIONS, seed=0)
            assert photo.row is not None
            problem = self.problem.with_blocks([detail.apply_to(photo, positions.take(photo.row))])
            # the photo's own light, from the light of its illumination
            start = Point(self.fit.point.materials, [self.fit.point.lights[k]])
            (illumination,) = problem.without_held_out().illuminations(start)
            likelihood = light_likelihood(illumination, self.fit.hyperparameters[k], self.prior, materials_given=True)
            likelihood, system, _ = descend_light(likelihood, LIGHT_STEPS)
            losses = held_out_losses(problem, Point(start.materials, [likelihood.light]))
            tick()
            return likelihood.marginal(system), losses

        tasks = [(index, *task) for index, task in enumerate(zip(self.photos, details, strict=True))]
        values, losses = zip(*self.problem.spread(score, tasks), strict=True)
        return PhotoScores(np.array(values), Losses(*([photo[i][0] for photo in losses] for i in (0, 1))))

    def fit_folds(
        self,
        parts: list[LightTerms],
        laplacian: csr_array,
        stiffness: Stiffness,
        movable: Bool[np.ndarray, " v"],
        tick: Tick,
    ) -> list[Detail]:
        """Return the surface detail for every photo, estimated from other photos.

        Photos are split into at most `FOLDS` folds; the detail for a photo is estimated from all other folds.

        Args:
            parts: Linearised lights on the mesh itself.
            laplacian: Laplacian of all meshes.
            stiffness: Stiffness of the detail.
            movable: Mask of the nodes whose normals may turn.
            tick: Called after each fold.
        """
        photos = self.photos
        folds = min(FOLDS, len(photos))

        def detail_without(fold: int) -> Detail:
            """Return the detail that is estimated without the photos of one fold."""
            left_out = [
                np.isin(block.photo, [j for n, j in photos[fold::folds] if n == k])
                for k, block in enumerate(self.problem.blocks)
            ]
            pairs = [(part, rows) for part, rows in zip(parts, left_out, strict=True) if not rows.all()]
            used = [part.drop_observations(rows) if rows.any() else part for part, rows in pairs]
            detail = solve_detail(used, laplacian, stiffness, zero_detail(self.surfaces.nodes), movable)
            positions = [positions.take(~rows) for positions, rows in zip(self.attached, left_out, strict=True)]
            # only turns that a displacement explains
            displacements = self.surfaces.displacements(detail.turn, positions)
            tick()
            return Detail(self.surfaces.turns_from_displacements(displacements), detail.log_factor)

        by_fold = list(self.problem.spread(detail_without, range(folds)))
        return [by_fold[number % folds] for number in range(len(photos))]


class StiffnessChoice(NamedTuple):
    """Likeliest stiffness of a detail, and the photos' scores by it.

    Attributes:
        stiffness: Stiffness.
        scores: Scores of the photos.
        evidence: Decision on the detail.
    """

    stiffness: Stiffness
    scores: PhotoScores
    evidence: Decision


class DetailSearch(msgspec.Struct, frozen=True, dict=True):
    """Search for the surface detail of a trial.

    Attributes:
        trial: Problem and its fit.
        parts: Linearised lights on the mesh itself.
        laplacian: Laplacian of all meshes.
        plain: Scores without detail.
        tick: Called after each unit of work.
    """

    trial: DetailTrial
    parts: list[LightTerms]
    laplacian: csr_array
    plain: PhotoScores
    tick: Tick

    @cached_property
    def photo_terms(self) -> list[LightTerms]:
        """Terms of each photo by itself, in a light of its own."""
        parts = [(self.parts[k], self.trial.problem.blocks[k].photo != j) for k, j in self.trial.photos]
        return [part.drop_observations(others) if others.any() else part for part, others in parts]

    def select_stiffness(
        self, candidates: Sequence[Stiffness], movable: Bool[np.ndarray, " v"]
    ) -> tuple[Stiffness, list[Detail]]:
        """Select the stiffness of the detail by which left-out photos are likeliest; return it with the details.

        Likelihoods are those of the linearised model.  The search goes from stiff to soft.  It ends at a stiffness that
        is less likely than the previous one.

        Args:
            candidates: Stiffnesses, from stiff to soft.
            movable: Mask of the nodes whose normals may turn.
        """
        choices = []
        values = [np.inf]
        for stiffness in candidates:
            details = self.trial.fit_folds(self.parts, self.laplacian, stiffness, movable, self.tick)
            values.append(round(self.change(details), 3))
            if values[-1] >= values[-2]:
                break
            choices.append((stiffness, details))
        return choices[-1]

    def change(self, details: Sequence[Detail]) -> float:
        """Return the change of −2 log likelihood of all photos by the detail for each, in the linearised model."""
        return sum(terms.change(detail) for terms, detail in zip(self.photo_terms, details, strict=True))

    def select_turns(self) -> tuple[StiffnessChoice, set[str]]:
        """Choose the stiffness of turned normals; return it with the meshes whose turns improve held-out photos."""
        trial = self.trial
        stiffness, details = self.select_stiffness([Stiffness(a) for a in TURN_STIFFNESSES], trial.shared_nodes)
        # meshes whose turns alone, without those of other meshes, improve held-out photos
        alone = {name: [trial.restrict_turns(detail, {name}) for detail in details] for name in trial.surfaces.meshes}
        movable = {name for name, restricted in alone.items() if self.change(restricted) < -2 * VERY_STRONG}
        if not movable:
            return StiffnessChoice(
                stiffness, self.plain, Decision(False, log_bayes_factor=-self.change(details) / 2)
            ), movable
        scores = trial.score_photos(
            [trial.restrict_turns(detail, movable) for detail in details], self.tick, self.plain
        )
        return StiffnessChoice(stiffness, scores, decide_turns(scores, self.plain)), movable


def estimate_surface(
    problem: JointProblem,
    surfaces: Surfaces,
    attached: list[SurfacePositions],
    start: Start,
    seed: int = 0,
    report: ProgressReport = lambda share, activity: None,
) -> SurfaceEstimate:
    """Return the detail of the meshes, if photos gain from detail that was estimated without them.

    Args:
        problem: All observations.
        surfaces: Subdivided meshes.
        attached: Attachment of each block to the surface.
        start: Maker of the initial fits.
        seed: Seed of the drawn observations.
        report: Called with the completed share and the current activity.
    """
    plain = zero_detail(surfaces.nodes)
    tick = section(report, 0.0, 0.5, TRIAL.points + BACKGROUND_SCHEDULE.points, "materials and lights")
    trial, initial = fit_trial(problem, start, seed, (surfaces, attached), tick)
    photos = len(trial.photos)
    if photos < 2 or problem.none_held_out:
        return SurfaceEstimate(initial, Decision(False))
    tick = section(report, 0.5, 0.95, 4 * len(TURN_STIFFNESSES) + 3 * photos, "left-out photos")
    scores = trial.score_photos([plain] * photos, tick)
    search = DetailSearch(trial, trial.linearise(plain, trial.fit), surfaces.laplacian(), scores, tick)
    turned, movable = search.select_turns()
    selected = turned if turned.evidence.accepted else StiffnessChoice(Stiffness(None), scores, turned.evidence)
    candidates = [Stiffness(selected.stiffness.turn, a) for a in FACTOR_STIFFNESSES]
    nodes = trial.shared_nodes & surfaces.node_mask(movable)
    stiffness, details = search.select_stiffness(candidates, nodes)
    with_paint = trial.score_photos(details, tick)
    painted = StiffnessChoice(stiffness, with_paint, decide_paint(with_paint, selected.scores))
    selected = painted if painted.evidence.accepted else selected
    if not (turned.evidence.accepted or painted.evidence.accepted):
        return SurfaceEstimate(initial, turned.evidence, painted.evidence)
    gains = dict(zip(trial.names, (scores.values - selected.scores.values).tolist(), strict=True))
    detail = solve_detail(search.parts, search.laplacian, selected.stiffness, plain, nodes)
    displacements = surfaces.displacements(detail.turn, attached) if turned.evidence.accepted else {}
    displacements = {name: displacement for name, displacement in displacements.items() if name in movable}
    factors = surfaces.by_mesh(detail.log_factor) if painted.evidence.accepted else {}
    decisions = turned.evidence, painted.evidence
    return SurfaceEstimate(initial, *decisions, selected.stiffness, gains, displacements, factors)


def fit_trial(
    problem: JointProblem, start: Start, seed: int, surface: tuple[Surfaces, list[SurfacePositions]], tick: Tick
) -> tuple[DetailTrial, InitialFit]:
    """Return the problem without detail with its fit, and the fit on few cells.

    Shadows and interreflection are those of the given meshes.

    Args:
        problem: All observations.
        start: Maker of the initial fits.
        seed: Seed of the drawn observations.
        surface: Subdivided meshes, and the attachment of each block to them.
        tick: Called at every evaluated point.
    """
    run = FitRunner(report=lambda event: tick())
    reliable = reliable_observations(problem)
    choices = SolveOptions(self_shadowing="on", interreflection="on", observations=OBSERVATIONS, seed=seed)
    effects = select_effects(reliable, start(reliable, TRIAL_CELLS), choices, run)
    lit = reliable.with_effects(effects.shadows.accepted, effects.interreflection.accepted)
    selection = select_backgrounds(lit, effects.fit, choices, run)
    effects = effects.with_fit(selection.fit, backgrounds=selection.evidence)
    problem = weighed_by_confidence(effects.effective_problem(problem))
    finer = refine_cells(effects.fit, CELLS, problem)
    fit = run.fit("surface", problem.subsample(OBSERVATIONS, seed), finer, LIGHTS_SCHEDULE)
    return DetailTrial(problem, fit, *surface, run.prior), InitialFit.from_fit(effects.fit, problem.blocks)


def section(report: ProgressReport, begin: float, end: float, number: int, activity: str) -> Tick:
    """Return a function that reports one more completed unit of work at each call.

    Args:
        report: Called with the completed share and the activity.
        begin: Share that is complete before.
        end: Share that is complete afterwards.
        number: Number of units.
        activity: Activity.
    """
    report(begin, activity)
    completed = count(1)
    return lambda *_: report(begin + (end - begin) * min(next(completed) / number, 1.0), activity)
