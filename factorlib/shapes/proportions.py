"""Factors of a shape's three axes, fitted to its outlines in all photos together with its poses.

    x_cam = R · (s ∘ x_object) + t,        s₁ s₂ s₃ = 1, because overall size is not observable                  (1)

The normal equations of every observation's contours (`factorlib.align.refine`) get two more unknowns, which all
observations share. As log s_k grows, a surface point at offset a from the mesh's centre moves by R e_k e_kᵀ Rᵀ a, and
the contour moves with it. The observations' own unknowns are eliminated (Schur complement) and follow by
back-substitution.
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

BOX = np.array([[2, -1, -1], [0, 1, -1]]).T / np.sqrt([6.0, 2.0])  # log s = BOX · d: all factors of product 1
ROUND = np.array([[-1, 2, -1]]).T / 6.0**0.5  # factors that keep a body of revolution about y
OF_FACTORS = 0.1**-2.0  # damping of d, as OF_POSES is that of poses
LARGEST_STEP = 0.15  # greatest step of d; twice as much for other unknowns
STILL = 1e-4  # a smaller step of d ends the iteration
Factors = Float[np.ndarray, "3"]


class Sighting(msgspec.Struct, frozen=True):
    """Observation of an object in a photo: mesh as read, with its own labels, target, camera and state."""

    mesh: Mesh
    target: Target
    camera: Camera
    prior: FocalPrior
    state: State


def fitted(
    sightings: Sequence[Sighting], steps: int, free: Float[np.ndarray, "3 k"] = BOX
) -> tuple[Factors, list[State], float]:
    """Fit factors of product 1 and states together by Gauss–Newton, starting from the mesh as it is.

    Args:
        sightings: The observations.
        steps: Greatest number of steps.
        free: Directions in which the logarithms of the factors may move.

    Returns:
        Factors, states and mean score of the best step.
    """
    shape = np.zeros(free.shape[1])
    states = [one.state for one in sightings]
    most = -np.inf
    best = np.ones(3), states
    for k in range(steps + 1):
        equations = []
        scores = []
        factors = np.exp(free @ shape)
        for one, state in zip(sightings, states, strict=True):
            seen = rendered(Caster(scaled(one.mesh, tuple(factors))), one.target, one.camera, state)
            jacobian = partial(jacobian_with_shape, free=free)
            equations.append(normal_equations(seen, one.target, one.prior, jacobian))
            scores.append(seen.score(one.target))
        if (score := float(np.mean(scores))) > most:
            best = (factors, states)
            most = score
        if k == steps:
            break
        by_shape, moves = _joint_step(equations, [one.prior.free for one in sightings])
        shape = shape + by_shape
        states = [state.moved(move) for state, move in zip(states, moves, strict=True)]
        if np.abs(by_shape).max(initial=0.0) < STILL:
            break
    return *best, most


def jacobian_with_shape(
    state: State, arms: Float[np.ndarray, "n 3"], free: Float[np.ndarray, "3 k"] = BOX
) -> Float[np.ndarray, "n 2 m"]:
    """Return the derivative of image points, in photo pixels, by the seven unknowns of `State.moved` and by d.

    Args:
        state: State of the mesh.
        arms: Offsets of surface points from the mesh's centre, camera axes.
        free: Directions in which the logarithms of the factors may move.

    Returns:
        A matrix for each point, m = 7 + k.
    """
    # R e_k e_kᵀ Rᵀ a, the move of a surface point by log s_k, times the directions of d
    along = arms @ state.rotation
    moves = np.einsum("dk,nk,kj->ndj", state.rotation, along, free)
    # derivative of the perspective projection
    point = arms + state.middle()
    slope = point[:, :2] / point[:, 2:]
    scale = (np.exp(state.log_focal) / point[:, 2])[:, None, None]
    by_shape = (moves[:, :2] - slope[:, :, None] * moves[:, 2:]) * scale
    return np.concatenate([state.jacobian(arms), by_shape], axis=-1)


def _joint_step(
    equations: Sequence[tuple[np.ndarray, np.ndarray]], free: Sequence[int]
) -> tuple[Float[np.ndarray, " k"], list[Float[np.ndarray, "7"]]]:
    """Return the damped step of d and the steps of each observation, whose first `free` unknowns move."""
    count = len(equations[0][1]) - 7
    # Schur complement of the observations' own unknowns
    shared = OF_FACTORS * np.eye(count)
    pull = np.zeros(count)
    own = []
    for (information, gradient), k in zip(equations, free, strict=True):
        matrix = information + np.diag(np.append(OF_POSES, np.zeros(count)))
        cross = matrix[:k, 7:]
        away = np.linalg.solve(matrix[:k, :k], np.column_stack([cross, gradient[:k]]))
        shared = shared + information[7:, 7:] - cross.T @ away[:, :count]
        pull = pull + gradient[7:] - cross.T @ away[:, count]
        own.append(away)
    # the step of d, then the own steps by back-substitution
    by_shape = np.clip(-np.linalg.solve(shared, pull), -LARGEST_STEP, LARGEST_STEP)
    steps = [np.clip(-away[:, count] - away[:, :count] @ by_shape, -2 * LARGEST_STEP, 2 * LARGEST_STEP) for away in own]
    return by_shape, [np.append(step, np.zeros(7 - len(step))) for step in steps]
