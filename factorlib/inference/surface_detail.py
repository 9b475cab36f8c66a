"""Surface detail: turned normals, chosen with their stiffness by held-out photos.

start       Materials and lights are fitted on few cells, with the shadows and interreflection of the given meshes.
            Lights are infinitely far away: near lights absorb what turns of wrong normals should explain (rough set of
            seed 0: 3.5 instead of 3.1 degrees).
stiffness   For each of `TURN_STIFFNESSES`, from stiff to soft, and for every fold, turns are estimated from all photos
            outside the fold.  A photo of the fold then gets its own light, with the materials given.  The stiffness
            with the largest marginal likelihood of the photos is used (`factorlib.inference.likelihood`); the search
            ends where that falls.  Every light has its own cells (`factorlib.inference.start`): with common cells,
            normals could turn toward the cells' centres in all photos at once.
decision    Turns are kept if the photos' log Bayes factor, summed, exceeds `VERY_STRONG`.  The held-out observations of
            six photos are too few: they refused turns with log Bayes factors of 100 to 317, by which relit pictures
            gain 1.0 and 3.4 dB (data/eames, captured set of seed 128).  Exact surfaces have negative ones.  Of several
            meshes, one stays as it is if the log Bayes factor of its turns alone does not exceed that.
nodes       Only nodes that two photos or more show turn.
rounds      Turns are estimated from all lights, and materials and lights are fitted again, `ROUNDS` times.
surface     The result is the displacement whose normals are nearest to the turned ones.  It excludes turns that no
            displacement explains: a wrong pose turns all normals of a photo.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array

from factorlib.inference.fit import Fit, FitSchedule, fit_problem, light_likelihood, reliable_observations
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import (
    CLEARLY_AGAINST,
    TRIAL,
    TRIAL_CELLS,
    VERY_STRONG,
    Losses,
    compare_models,
    held_out_losses,
    select_backgrounds,
    select_effects,
)
from factorlib.inference.optimizer import descend_light
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.inference.start import InitialFit, Start, refine_cells
from factorlib.inference.surface_turns import (
    LightTerms,
    SurfacePositions,
    Surfaces,
    linearise_light,
    solve_turns,
)
from factorlib.light.prior import LightPrior, read_light_prior
from factorlib.results.materials import Decision

# a of `factorlib.inference.surface_turns`; b is a share of it.
TURN_STIFFNESSES = (1000.0, 300.0, 100.0, 30.0, 10.0)
ROUNDS = 3
CELLS = 250  # cells of a light
FOLDS = 4  # folds of photos
OBSERVATIONS = 1000  # fitted observations of a light, or of a held-out photo
START_SCHEDULE = FitSchedule(light_steps=2, descents=(3, 2), estimate_first=False)
ROUND_SCHEDULE = FitSchedule(descents=(2,), estimate_first=False)
LIGHT_STEPS = 2  # factorisations in the fit of a held-out photo's light


class SurfaceEstimate(msgspec.Struct, frozen=True):
    """Surface detail of all meshes of a set.

    Attributes:
        beginning: Fit on few cells to the meshes as they are, from which a solve starts.
        evidence: Decision on turns, by held-out photos.
        stiffness: Stiffness of the chosen turns; None if they are not kept.
        gains: Decrease of −2 log marginal likelihood of each held-out photo by the kept turns.
        displacements: Displacements at the nodes of each moved mesh, in units of the mesh's extent.
    """

    beginning: InitialFit
    evidence: Decision
    stiffness: float | None = None
    gains: dict[str, float] = {}
    displacements: dict[str, Float[np.ndarray, " n"]] = {}


ProgressReport = Callable[[float, str], None]  # completed share, and the current activity
Tick = Callable[..., None]  # called at the end of each unit of work
Turns = Float[np.ndarray, "v 3"]  # δ at all nodes


class PhotoScores(msgspec.Struct, frozen=True):
    """Scores of each photo, with turns that were estimated from other photos.

    Attributes:
        values: −2 log marginal likelihood of each photo.
        losses: Held-out losses of each photo.
    """

    values: Float[np.ndarray, " f"]
    losses: Losses

    def gain_over(self, reference: PhotoScores) -> float:
        """Return the mean decrease of the values, in standard errors over photos."""
        gains = reference.values - self.values
        return float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-12))

    def evidence_over(self, reference: PhotoScores) -> Decision:
        """Return the decision on turns: kept if their log Bayes factor exceeds `VERY_STRONG`."""
        factor = float((reference.values - self.values).sum()) / 2
        evidence = compare_models(reference.losses, self.losses, 0.0)
        return msgspec.structs.replace(evidence, accepted=factor > VERY_STRONG, log_bayes_factor=factor)


class DetailTrial(msgspec.Struct, frozen=True):
    """Baseline of a search for surface detail: the problem on the bare meshes, its fit, and where observations lie.

    Attributes:
        problem: Observations.
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

    def with_turns(self, turn: Turns) -> JointProblem:
        """Return the problem with turned normals."""
        blocks = zip(self.problem.blocks, self.attached, strict=True)
        return self.problem.with_blocks([positions.turn_block(block, turn) for block, positions in blocks])

    def linearise(self, turn: Turns, fit: Fit) -> list[LightTerms]:
        """Linearise every light at turned normals."""
        tasks = zip(self.with_turns(turn).illuminations(fit.point), fit.hyperparameters, self.attached, strict=True)
        nodes = self.surfaces.nodes
        return list(
            self.problem.spread(lambda task: linearise_light(task[0], task[1], self.prior, task[2], nodes), list(tasks))
        )

    def restrict_turns(self, turn: Turns, meshes: set[str]) -> Turns:
        """Return the turns on some meshes alone, called `meshes`."""
        return np.where(self.surfaces.node_mask(meshes)[:, None], turn, 0.0)

    @property
    def no_turns(self) -> Turns:
        """Turns of the mesh itself, all zero."""
        return np.zeros((self.surfaces.nodes, 3))

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
        self, turns: Sequence[Turns], tick: Tick = lambda: None, plain: PhotoScores | None = None
    ) -> PhotoScores:
        """Score every photo by itself, with the turns for it, in a light fitted to it, with the materials fixed.

        Args:
            turns: Turns for each photo, estimated from other photos.
            tick: Called after each photo.
            plain: Scores without turns, used for a photo whose turns are zero; None to compute all.
        """

        def score(task: tuple[int, tuple[int, int], Turns]) -> tuple[float, Losses]:
            """Return one photo's value and losses."""
            index, (k, number), turn = task
            rows = self.problem.blocks[k].photo == number
            positions = self.attached[k].take(rows)
            if plain is not None and not np.any(turn[positions.node]):
                tick()
                return plain.values[index], Losses([plain.losses.values[index]], [plain.losses.clusters[index]])
            photo = msgspec.structs.replace(self.problem.blocks[k].take(rows), row=np.arange(rows.sum()))
            photo = photo.subsample(OBSERVATIONS, seed=0)
            assert photo.row is not None
            problem = self.problem.with_blocks([positions.take(photo.row).turn_block(photo, turn)])
            # the photo's own light, from the light of its illumination
            start = Point(self.fit.point.materials, [self.fit.point.lights[k]])
            (illumination,) = problem.without_held_out().illuminations(start)
            likelihood = light_likelihood(illumination, self.fit.hyperparameters[k], self.prior, materials_given=True)
            likelihood, system = descend_light(likelihood, LIGHT_STEPS)
            losses = held_out_losses(problem, Point(start.materials, [likelihood.light]))
            tick()
            return likelihood.marginal(system), losses

        tasks = [(index, *task) for index, task in enumerate(zip(self.photos, turns, strict=True))]
        values, losses = zip(*self.problem.spread(score, tasks), strict=True)
        return PhotoScores(np.array(values), Losses(*([photo[i][0] for photo in losses] for i in (0, 1))))

    def fit_folds(
        self,
        parts: list[LightTerms],
        laplacian: csr_array,
        stiffness: float,
        tick: Tick,
    ) -> list[Turns]:
        """Return the turns for every photo, estimated from other photos.

        Photos are split into at most `FOLDS` folds; the turns for a photo are estimated from all other folds.

        Args:
            parts: Linearised lights on the mesh itself.
            laplacian: Laplacian of all meshes.
            stiffness: Stiffness of the turns.
            tick: Called after each fold.
        """
        photos = self.photos
        folds = min(FOLDS, len(photos))

        def turns_without(fold: int) -> Turns:
            """Return the turns that are estimated without the photos of one fold."""
            left_out = [
                np.isin(block.photo, [j for n, j in photos[fold::folds] if n == k])
                for k, block in enumerate(self.problem.blocks)
            ]
            pairs = zip(parts, left_out, strict=True)
            used = [part.drop_observations(rows) if rows.any() else part for part, rows in pairs]
            used = [part for part in used if len(part.residual)]
            turn = solve_turns(used, laplacian, stiffness, self.no_turns, self.shared_nodes)
            positions = [positions.take(~rows) for positions, rows in zip(self.attached, left_out, strict=True)]
            # only turns that a displacement explains
            displacements = self.surfaces.displacements(turn, positions)
            tick()
            return self.surfaces.turns_from_displacements(displacements)

        by_fold = list(self.problem.spread(turns_without, range(folds)))
        return [by_fold[number % folds] for number in range(len(photos))]


class StiffnessChoice(NamedTuple):
    """Result of a search for the likeliest stiffness.

    Attributes:
        stiffness: Stiffness.
        turns: Turns for each photo, estimated from other photos.
        scores: Scores of the photos.
        evidence: Decision on the turns.
    """

    stiffness: float
    turns: list[Turns]
    scores: PhotoScores
    evidence: Decision


class DetailSearch(msgspec.Struct, frozen=True):
    """Search for the surface detail of a trial.

    Attributes:
        trial: Problem and its fit.
        parts: Linearised lights on the mesh itself.
        laplacian: Laplacian of all meshes.
        plain: Scores without turns.
        tick: Called after each unit of work.
    """

    trial: DetailTrial
    parts: list[LightTerms]
    laplacian: csr_array
    plain: PhotoScores
    tick: Tick

    def select_stiffness(self) -> StiffnessChoice:
        """Select the stiffness of the turns with the largest marginal likelihood of the photos.

        The search goes from stiff to soft.  It ends at a stiffness that is less likely than the previous one, or
        with clear evidence against turns.
        """
        best: StiffnessChoice | None = None
        for stiffness in TURN_STIFFNESSES:
            turns = self.trial.fit_folds(self.parts, self.laplacian, stiffness, self.tick)
            scores = self.trial.score_photos(turns, self.tick, self.plain)
            if best is not None and round(float(scores.values.sum() - best.scores.values.sum()), 3) >= 0:
                break
            best = StiffnessChoice(stiffness, turns, scores, scores.evidence_over(self.plain))
            if scores.gain_over(self.plain) < CLEARLY_AGAINST:
                break
        assert best is not None
        return best

    def select_turns(self) -> tuple[StiffnessChoice, set[str]]:
        """Choose the stiffness of turned normals; return it with the meshes whose turns improve held-out photos."""
        best = self.select_stiffness()
        movable = self.select_meshes(best.turns) if best.evidence.accepted else set()
        if 0 < len(movable) < len(self.trial.surfaces.meshes):
            restricted = [self.trial.restrict_turns(turn, movable) for turn in best.turns]
            scores = self.trial.score_photos(restricted, self.tick, self.plain)
            best = best._replace(scores=scores, evidence=scores.evidence_over(self.plain))
        return best, movable

    def fit_all_photos(self, stiffness: float, movable: set[str], pieces: ProgressSections, seed: int) -> Turns:
        """Return the turns from all photos, with materials and lights fitted again between their steps.

        Args:
            stiffness: Stiffness of the turns.
            movable: Meshes whose normals may turn.
            pieces: Progress report, divided into sections.
            seed: Seed of the drawn observations.
        """
        trial = self.trial
        parts = self.parts
        fit = self.trial.fit
        nodes = trial.surfaces.node_mask(movable) & trial.shared_nodes
        turn = trial.no_turns
        for number in range(ROUNDS):
            begin = 0.85 + 0.05 * number
            tick = pieces.section(begin, begin + 0.05, ROUND_SCHEDULE.points, f"all photos, round {number + 1}")
            if number:
                sample = trial.with_turns(turn).subsample(OBSERVATIONS, seed)
                fit = fit_problem(sample, fit, trial.prior, ROUND_SCHEDULE, tick)
                parts = trial.linearise(turn, fit)
            turn = solve_turns(parts, self.laplacian, stiffness, turn, nodes)
        return turn

    def select_meshes(self, turns: Sequence[Turns]) -> set[str]:
        """Return the meshes whose turns alone, without those of other meshes, improve held-out photos."""
        names = self.trial.surfaces.meshes
        if len(names) == 1:
            return set(names)
        restricted = [(name, [self.trial.restrict_turns(turn, {name}) for turn in turns]) for name in names]
        scores = {name: self.trial.score_photos(turns, self.tick, self.plain) for name, turns in restricted}
        return {name for name, mesh_scores in scores.items() if mesh_scores.evidence_over(self.plain).accepted}


def estimate_surface(
    problem: JointProblem,
    surfaces: Surfaces,
    attached: list[SurfacePositions],
    start: Start,
    seed: int = 0,
    report: ProgressReport = lambda share, activity: None,
) -> SurfaceEstimate:
    """Return the detail of the meshes, if photos gain from turns that were estimated without them.

    Args:
        problem: All observations.
        surfaces: Subdivided meshes.
        attached: Attachment of each block to the surface.
        start: Maker of the initial fits.
        seed: Seed of the drawn observations.
        report: Called with the completed share and the current activity.
    """
    pieces = ProgressSections(report)
    tick = pieces.section(0.0, 0.3, TRIAL.points + START_SCHEDULE.points, "materials and lights")
    trial, initial = fit_trial(problem, start, seed, (surfaces, attached), tick)
    photos = len(trial.photos)
    if photos < 2 or problem.none_held_out:
        return SurfaceEstimate(initial, Decision(False))
    tick = pieces.section(0.3, 0.85, 2 * len(TURN_STIFFNESSES) * photos, "left-out photos")
    scores = trial.score_photos([trial.no_turns] * photos, tick)
    search = DetailSearch(trial, trial.linearise(trial.no_turns, trial.fit), surfaces.laplacian(), scores, tick)
    best, movable = search.select_turns()
    if not best.evidence.accepted:
        return SurfaceEstimate(initial, best.evidence)
    gains = dict(zip(trial.names, (scores.values - best.scores.values).tolist(), strict=True))
    turn = search.fit_all_photos(best.stiffness, movable, pieces, seed)
    displacements = surfaces.displacements(turn, attached)
    displacements = {name: displacement for name, displacement in displacements.items() if name in movable}
    return SurfaceEstimate(initial, best.evidence, best.stiffness, gains, displacements)


def fit_trial(
    problem: JointProblem, start: Start, seed: int, surface: tuple[Surfaces, list[SurfacePositions]], tick: Tick
) -> tuple[DetailTrial, InitialFit]:
    """Return the problem on the bare meshes with its fit, and the fit on few cells.

    Shadows and interreflection are those of the given meshes.

    Args:
        problem: All observations.
        start: Maker of the initial fits.
        seed: Seed of the drawn observations.
        surface: Subdivided meshes, and the attachment of each block to them.
        tick: Called at every evaluated point.
    """
    prior = read_light_prior()
    reliable = reliable_observations(problem)

    def fitting(name: str, sample: JointProblem, start_fit: Fit, schedule: FitSchedule) -> Fit:
        """Fit under the prior on lights."""
        return fit_problem(sample, start_fit, prior, schedule, tick)

    choices = SolveOptions(self_shadowing="on", interreflection="on", seed=seed)
    effects = select_effects(reliable, start(reliable, TRIAL_CELLS), choices, fitting)
    lit = reliable.with_effects(effects.shadows.accepted, effects.interreflection.accepted)
    selection = select_backgrounds(lit, effects.fit, choices, fitting)
    effects = effects.with_fit(selection.fit, backgrounds=selection.evidence)
    problem = effects.effective_problem(problem)
    fit = fit_problem(
        problem.subsample(OBSERVATIONS, seed), refine_cells(effects.fit, CELLS, problem), prior, START_SCHEDULE, tick
    )
    return DetailTrial(problem, fit, *surface, prior), InitialFit.from_fit(effects.fit, problem.blocks)


class ProgressSections(msgspec.Struct, frozen=True):
    """Progress report of a search, divided into sections of equal units of work."""

    report: ProgressReport

    def section(self, begin: float, end: float, number: int, activity: str) -> Tick:
        """Return a function that reports one more completed unit of work at each call.

        Args:
            begin: Share that is complete before.
            end: Share that is complete afterwards.
            number: Number of units.
            activity: Activity.
        """
        self.report(begin, activity)
        completed = count(1)
        return lambda *_: self.report(begin + (end - begin) * min(next(completed) / number, 1.0), activity)
