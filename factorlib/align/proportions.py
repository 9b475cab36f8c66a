"""A mesh whose proportions differ from the object's: factors of its three axes, from all photos that show it.

    x_cam = R · (s ∘ x_object) + t,        s₁ s₂ s₃ = 1: overall size is not seen

The contours' normal equations of every sighting (`factorlib.align.refine`) get two more unknowns, which all sightings share:
a surface point at arm a from the mesh's middle moves by R e_k e_kᵀ Rᵀ a as log s_k grows, and the contour with it.  The
sightings' own unknowns are eliminated (Schur complement) and follow.

One photo alone can take a wrong proportion for a turn.  So factors are used only where they pay on photos that had no say in
them: each part of the sightings in turn is left out, the factors are fitted to the others, and only its poses are fitted to it.
"""

from collections.abc import Sequence
from functools import partial
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.align.refine import DAMPING as OF_POSES
from factorlib.align.refine import FocalPrior, normal_equations, refined, rendered
from factorlib.align.state import State
from factorlib.align.target import Target
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh, scaled

BOX = np.array([[2, -1, -1], [0, 1, -1]]).T / np.sqrt([6.0, 2.0])  # log s = BOX · d, all factors of product 1
ROUND = np.array([[-1, 2, -1]]).T / 6.0**0.5  # those that leave a body of revolution about y one
OF_FACTORS = 0.1**-2.0  # damping of d, as OF_POSES
LARGEST_STEP = 0.15  # of the logarithms d; of other unknowns twice as much
STILL = 1e-4  # a step of d that ends the descent
PARTS = 4  # that are left out in turn, at most
Factors = Float[np.ndarray, "3"]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Standards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When factors are used."""

    least_gain: Share = 0.2
    """Share of what silhouettes of photos left out leave unexplained that factors must explain to be used."""
    least_share: Share = 0.003
    """Share of the mask's pixels that factors must explain to be used."""
    steps: Annotated[int, msgspec.Meta(ge=1, le=100)] = 15
    """Gauss-Newton steps of factors and poses together."""


class Sighting(msgspec.Struct, frozen=True):
    """An object in a photo: its mesh with its own labels, as read; what is seen of it; where it is taken to be."""

    mesh: Mesh
    target: Target
    camera: Camera
    prior: FocalPrior
    state: State


class Verdict(msgspec.Struct, frozen=True):
    """Whether factors are used, the factors, their product 1, and the state of each sighting with them; shares of the mask
    that silhouettes leave unexplained, mean over the sightings.

    held_out_before, held_out_after: with the mesh as it is and with factors of other photos, poses fitted to both alike
    """

    used: bool
    reason: str
    factors: Factors
    states: list[State]
    held_out_before: float | None = None
    held_out_after: float | None = None


def proportions(sightings: Sequence[Sighting], standards: Standards = Standards()) -> Verdict:
    """Factors of the one mesh that all sightings show; exactly 1 where they are not used."""
    as_it_is = np.ones(3), [one.state for one in sightings]
    if len(sightings) < 2:
        return Verdict(False, "one photo alone can take a wrong proportion for a turn", *as_it_is)
    before, after = [], []
    count = len(sightings)
    for part in ([*range(first, count, PARTS)] for first in range(min(count, PARTS))):  # left out together
        others = [one for k, one in enumerate(sightings) if k not in part]
        factors, _, _ = fitted(others, standards.steps)
        for k in part:
            before.append(unexplained(sightings[k], np.ones(3), standards.steps))
            after.append(unexplained(sightings[k], factors, standards.steps))
    losses = float(np.mean(before)), float(np.mean(after))
    gain = losses[0] - losses[1]
    if gain < max(standards.least_gain * losses[0], standards.least_share):
        return Verdict(False, "photos left out are explained no better", *as_it_is, *losses)
    return Verdict(True, "photos left out are explained better", *fitted(sightings, standards.steps)[:2], *losses)


def unexplained(one: Sighting, factors: Factors, steps: int) -> float:
    """The share of the mask at the best pose of the mesh with these factors."""
    caster = Caster(scaled(one.mesh, tuple(factors)))
    return 1 - refined(caster, one.target, one.camera, one.state, one.prior, steps).score


def fitted(
    sightings: Sequence[Sighting], steps: int, free: Float[np.ndarray, "3 k"] = BOX
) -> tuple[Factors, list[State], float]:
    """Factors, of product 1, and states together, by Gauss-Newton from the mesh as it is; the best met, and their mean score.

    free: directions in which the logarithms of the factors may go
    """
    shape, states, most = np.zeros(free.shape[1]), [one.state for one in sightings], -np.inf
    best = np.ones(3), states
    for k in range(steps + 1):
        equations, scores, factors = [], [], np.exp(free @ shape)
        for one, state in zip(sightings, states, strict=True):
            seen = rendered(Caster(scaled(one.mesh, tuple(factors))), one.target, one.camera, state)
            jacobian = partial(jacobian_with_shape, free=free)
            equations.append(normal_equations(seen, one.target, one.prior, jacobian))
            scores.append(seen.score(one.target))
        if (score := float(np.mean(scores))) > most:
            best, most = (factors, states), score
        if k == steps:
            break
        by_shape, moves = _joint_step(equations, [one.prior.free for one in sightings])
        shape, states = shape + by_shape, [state.moved(move) for state, move in zip(states, moves, strict=True)]
        if np.abs(by_shape).max(initial=0.0) < STILL:
            break
    return *best, most


def jacobian_with_shape(
    state: State, arms: Float[np.ndarray, "n 3"], free: Float[np.ndarray, "3 k"] = BOX
) -> Float[np.ndarray, "n 2 m"]:
    """∂ image point / ∂ (the seven unknowns of `State.moved`, d), photo pixels."""
    along = arms @ state.rotation  # the arm in the object's axes, as it is scaled
    moves = np.einsum("dk,nk,kj->ndj", state.rotation, along, free)
    point = arms + state.middle()
    slope, scale = point[:, :2] / point[:, 2:], (np.exp(state.log_focal) / point[:, 2])[:, None, None]
    by_shape = (moves[:, :2] - slope[:, :, None] * moves[:, 2:]) * scale
    return np.concatenate([state.jacobian(arms), by_shape], axis=-1)


def _joint_step(
    equations: Sequence[tuple[np.ndarray, np.ndarray]], free: Sequence[int]
) -> tuple[Float[np.ndarray, " k"], list[Float[np.ndarray, "7"]]]:
    """The damped step of d, and the sightings' own steps, in which the first `free` unknowns move."""
    count = len(equations[0][1]) - 7
    shared, pull, own = OF_FACTORS * np.eye(count), np.zeros(count), []
    for (information, gradient), k in zip(equations, free, strict=True):
        matrix = information + np.diag(np.append(OF_POSES, np.zeros(count)))
        cross = matrix[:k, 7:]
        away = np.linalg.solve(matrix[:k, :k], np.column_stack([cross, gradient[:k]]))
        shared = shared + information[7:, 7:] - cross.T @ away[:, :count]
        pull = pull + gradient[7:] - cross.T @ away[:, count]
        own.append(away)
    by_shape = np.clip(-np.linalg.solve(shared, pull), -LARGEST_STEP, LARGEST_STEP)
    steps = [np.clip(-away[:, count] - away[:, :count] @ by_shape, -2 * LARGEST_STEP, 2 * LARGEST_STEP) for away in own]
    return by_shape, [np.append(step, np.zeros(7 - len(step))) for step in steps]
