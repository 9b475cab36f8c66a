"""Whether a set's surfaces are turned by shading, how stiff they are, and the displacement that they end with.

start      materials and lights are fitted on few cells, as the solve begins
stiffness  of each of `STIFFNESS`, from stiff to soft, turns are found from all photos but one, for every photo in turn; that photo then gets a light of its
           own, with the materials given, and what counts is minus twice the log marginal likelihood of its observations
           (`factorlib.solve.marginal`), without turns and with them.  The stiffness that all photos together gain most by is used
whether    turns are kept where that gain is above zero and the held-out observations of photos that had no part in the turns are explained better
           by more than `FOR` standard errors (`factorlib.solve.evidence`)
rounds     turns from all lights, materials and lights fitted again, `ROUNDS` times
surface    at last the displacement whose normals come nearest to the turned ones: what no displacement explains (a wrong pose turns all normals
           of a photo) is left out
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.sparse import block_diag, csr_array

from factorlib.light.prior import LightPrior
from factorlib.meshes.fine import Fine
from factorlib.model.materials import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.choices import effects_chosen
from factorlib.solve.evidence import FOR, Evidence, Losses, compare, losses_of
from factorlib.solve.fit import Fit, Schedule, field_of, fitted, sure_ones
from factorlib.solve.marginal import marginal
from factorlib.solve.options import Choices
from factorlib.solve.start import Start
from factorlib.surface.turns import Attached, Part, part_of, step, with_normals

STIFFNESS = (1000.0, 300.0, 100.0, 30.0)  # a of `factorlib.surface.turns`; b is a share of it
ROUNDS = 3
CELLS = 250  # of a light
SETTLE = Schedule(together=(6, 4))
BETWEEN = Schedule(together=(3,), estimate=False)
OWN_LIGHT = Schedule(lights=6, estimate=False, given=True)


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
        """Of all meshes, [v, v]."""
        return csr_array(block_diag([mesh.laplacian() for mesh in self.meshes.values()]))

    def displacements(
        self, turn: Float[np.ndarray, "v 3"], attached: Sequence[Attached]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """By mesh, in its extents: what `Fine.displacement` finds for the turns of its nodes, as far as observations are attached to them."""
        weight = sum(np.bincount(of.node.reshape(-1), of.share.reshape(-1), self.nodes) for of in attached)
        seen = np.minimum(weight, 1.0)
        return {
            name: mesh.displacement(turn[own], seen[own])
            for name, mesh in self.meshes.items()
            for own in [slice(self.first[name], self.first[name] + mesh.nodes)]
        }

    def turns_of(self, displacements: dict[str, Float[np.ndarray, " n"]]) -> Float[np.ndarray, "v 3"]:
        """The turns that displacements mean."""
        return np.vstack([mesh.turn_of(displacements[name]) for name, mesh in self.meshes.items()])


class Found(msgspec.Struct, frozen=True):
    """What was found.

    evidence  whether surfaces are turned, by held-out observations of photos that had no part in the turns
    stiffness that was best;  gains: of it, by photo: how much −2 log marginal likelihood fell while the photo had no part in the turns
    displacements  by mesh, at nodes, in extents; none where surfaces stay
    """

    evidence: Evidence
    stiffness: float | None = None
    gains: dict[str, float] = {}
    displacements: dict[str, Float[np.ndarray, " n"]] = {}


Report = Callable[[float, str], None]  # the share that is done, and what is being done


class _Trial(msgspec.Struct, frozen=True):
    """A problem, its fit and what its blocks are attached to."""

    problem: JointProblem
    fit: Fit
    surfaces: Surfaces
    attached: list[Attached]
    prior: LightPrior

    def turned(self, turn: Float[np.ndarray, "v 3"]) -> JointProblem:
        """The problem on turned normals."""
        pairs = zip(self.problem.blocks, self.attached, strict=True)
        return self.problem.of([with_normals(b, at.turned(b.normal, b.view, turn)) for b, at in pairs])

    def parts(self, turn: Float[np.ndarray, "v 3"], fit: Fit) -> list[Part]:
        """Every light linearised on turned normals."""
        operators = [of.operator(self.surfaces.nodes) for of in self.attached]
        each = zip(self.turned(turn).illuminations(fit.point), fit.hyperparameters, operators, strict=True)
        return list(self.problem.spread(lambda one: part_of(one[0], one[1], self.prior, one[2]), list(each)))

    @property
    def photos(self) -> list[tuple[int, int]]:
        """Each photo that has observations: its block and its number there."""
        return [(k, int(j)) for k, block in enumerate(self.problem.blocks) for j in np.unique(block.photo)]

    def alone(self, photo: tuple[int, int], turn: Float[np.ndarray, "v 3"]) -> tuple[float, Losses]:
        """A light for this photo alone, with the materials given: −2 log marginal likelihood, and the losses of its held-out observations."""
        k, number = photo
        (block,), counts = self.turned(turn).restricted([k]).blocks, [self.fit.hyperparameters[k]]
        problem = self.problem.of([block.take(block.photo == number)])
        begun = Fit(Point(self.fit.point.materials, [self.fit.point.lights[k]]), counts)
        point = fitted(problem, begun, self.prior, OWN_LIGHT).point
        (own,) = problem.fitted().illuminations(point)
        return marginal(field_of(own, counts[0], self.prior)).value, losses_of(problem, point)


def found(
    problem: JointProblem,
    surfaces: Surfaces,
    attached: list[Attached],
    start: Start,
    prior: LightPrior,
    seed: int = 0,
    report: Report = lambda share, what: None,
) -> Found:
    """The displacements of the meshes, if photos that had no part in them gain.

    problem: all observations;  attached: where each block's lie;  start: where materials and lights begin;  seed: of what is drawn
    """
    report(0.0, "materials and lights")
    sure = sure_ones(problem)
    choices = Choices(self_shadowing="on", interreflection="on", seed=seed)
    effects = effects_chosen(sure, start(sure, CELLS), choices, lambda _, *of: fitted(of[0], of[1], prior, of[2]))
    fit = fitted(effects.of(problem), effects.fit, prior, SETTLE)
    trial = _Trial(effects.of(problem), fit, surfaces, attached, prior)
    laplacian, still, photos = surfaces.laplacian(), np.zeros((surfaces.nodes, 3)), trial.photos
    if len(photos) < 2 or problem.none_held_out:
        return Found(Evidence(False))
    parts = trial.parts(still, fit)
    plain = list(problem.spread(partial(trial.alone, turn=still), photos))

    def left_out(photo: tuple[int, int], stiffness: float) -> tuple[float, Losses]:
        """A photo on the surface that all others ask for."""
        gone = [(problem.blocks[k].photo == photo[1]) & (k == photo[0]) for k in range(len(parts))]
        others = [part.without(rows) if rows.any() else part for part, rows in zip(parts, gone, strict=True)]
        turn = step([part for part in others if len(part.residual)], laplacian, stiffness, still)
        seen = [of.take(~rows) for of, rows in zip(attached, gone, strict=True)]
        return trial.alone(photo, surfaces.turns_of(surfaces.displacements(turn, seen)))

    best = None
    for number, stiffness in enumerate(STIFFNESS):
        report(0.3 + 0.1 * number, f"left-out photos, stiffness {stiffness:g}")
        tried = list(problem.spread(partial(left_out, stiffness=stiffness), photos))
        gains = np.array([before - after for (before, _), (after, _) in zip(plain, tried, strict=True)])
        if best is None or gains.sum() > best[0].sum():
            best = gains, stiffness, tried
    gains, stiffness, tried = best
    evidence = compare(*(_joined([losses for _, losses in of]) for of in (plain, tried)), FOR)
    evidence = msgspec.structs.replace(evidence, kept=evidence.kept and bool(gains.sum() > 0))
    names = [problem.blocks[k].photos[number] for k, number in photos]
    by_photo = {name: float(gain) for name, gain in zip(names, gains, strict=True)}
    if not evidence.kept:
        return Found(evidence, stiffness, by_photo)
    turn = still
    for number in range(ROUNDS):
        report(0.7 + 0.1 * number, f"normals, round {number + 1}")
        if number:
            fit = fitted(trial.turned(turn), fit, prior, BETWEEN)
            parts = trial.parts(turn, fit)
        turn = step(parts, laplacian, stiffness, turn)
    return Found(evidence, stiffness, by_photo, surfaces.displacements(turn, attached))


def _joined(losses: Sequence[Losses]) -> Losses:
    """The losses of photos that were judged one by one."""
    return Losses([one.values[0] for one in losses], [one.clusters[0] for one in losses])
