"""Factors of a shape's three axes, fitted to its outlines in all photos together with its poses.

    x_cam = R · (s ∘ x_object) + t,        s₁ s₂ s₃ = 1: overall size is not seen

The contours' normal equations of every sighting (`factorlib.align.refine`) get two more unknowns, which all sightings share:
a surface point at arm a from the mesh's middle moves by R e_k e_kᵀ Rᵀ a as log s_k grows, and the contour with it.  The
sightings' own unknowns are eliminated (Schur complement) and follow.
"""

from collections.abc import Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.align.refine import DAMPING as OF_POSES
from factorlib.align.refine import FocalPrior, normal_equations, rendered
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
Factors = Float[np.ndarray, "3"]


class Sighting(msgspec.Struct, frozen=True):
    """An object in a photo: its mesh, its outline, and the state at which the fit begins."""

    mesh: Mesh
    target: Target
    camera: Camera
    prior: FocalPrior
    state: State


def fitted(
    sightings: Sequence[Sighting], steps: int, free: Float[np.ndarray, "3 k"] = BOX
) -> tuple[Factors, list[State], float]:
    """Fit factors, of product 1, and states together by Gauss-Newton; return the best ones and their mean score.

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
