"""Spheres, boxes and cylinders, with proportions fitted to outlines in all photos together with the poses.

A sphere has no free proportion, a box has two, a cylinder (about y) one. They are factors s of the shape's axes:

    x_cam = R · (s ∘ x_object) + t,        s₁ s₂ s₃ = 1, because overall size is not observable                  (1)

The fit starts from several shapes, each placed on the `PHOTOS` photos that show most pixels. The shape of the largest
overlap is kept. The normal equations of every observation's contours (`factorlib.align.refine`) get two more unknowns,
which all observations share. As log s_k grows, a surface point at offset a from the mesh's centre moves by
R e_k e_kᵀ Rᵀ a, and the contour moves with it. The photos' own unknowns are eliminated (Schur complement) and follow by
back-substitution.
"""

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float

from factorlib.align.refine import DAMPING, PoseState, normal_equations, render
from factorlib.align.search import SearchOptions, estimate_pose
from factorlib.align.silhouette import Target, make_target
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import Mesh, scale_mesh
from factorlib.shapes.outline import Outline, Triangles

# initial factors of the axes
STARTS = {
    "box": ((1, 1, 1), (1, 0.5, 1), (1, 2, 1), (1, 0.25, 0.5), (1, 0.1, 1), (1, 0.2, 0.8)),
    "cylinder": ((1, 0.3, 1), (1, 1, 1), (1, 3, 1)),
}
PHOTOS = 6  # greatest number of photos used
STEPS = 20  # Gauss–Newton steps of factors and poses
RESOLUTION = 200  # pixels of the mask's longer side
SEARCH = SearchOptions(views=150, keep=(20, 8, 4, 2))
BOX = np.array([[2, -1, -1], [0, 1, -1]]).T / np.sqrt([6.0, 2.0])  # log s = BOX · d: all factors of product 1
ROUND = np.array([[-1, 2, -1]]).T / 6.0**0.5  # factors that keep a body of revolution about y
FREE_FACTORS = {"box": BOX, "cylinder": ROUND}
FACTOR_DAMPING = 0.1**-2.0  # damping of d, as DAMPING is that of poses
LARGEST_STEP = 0.15  # greatest step of d; twice as much for other unknowns
STILL = 1e-4  # a smaller step of d ends the iteration
Factors = Float[np.ndarray, "3"]


def primitive(
    kind: str, outlines: Sequence[Outline], report: Callable[[float], None] = lambda share: None
) -> Triangles:
    """Fit a primitive to outlines and return it at unit size.

    Args:
        kind: "ball", "box" or "cylinder".
        outlines: Outlines, at least one, each with some pixel of the object.
        report: Called with the completed share, from 0 to 1.

    Returns:
        The mesh with its overlap.
    """
    outlines = sorted(outlines, key=lambda outline: -int((outline.part > 0).sum()))[:PHOTOS]
    targets = [make_target(outline.view, (1,), RESOLUTION) for outline in outlines]
    starts = STARTS.get(kind, ((1, 1, 1),))
    best: tuple[float, Float[np.ndarray, "3"]] = -1.0, np.ones(3)
    for index, start in enumerate(starts):
        report(index / len(starts))
        mesh = unit_shape(kind, np.array(start, float)).as_mesh()
        caster = Caster(mesh)
        states = [estimate_pose(caster, outline.view, SEARCH).state for outline in outlines]
        factors, score = fit_proportions(mesh, targets, states, STEPS, FREE_FACTORS.get(kind, np.zeros((3, 0))))
        if score > best[0]:
            best = score, factors * start
    return msgspec.structs.replace(unit_shape(kind, best[1]).with_size(1.0), overlap=best[0])


def unit_shape(kind: str, factors: Float[np.ndarray, "3"]) -> Triangles:
    """Return the unit shape of a kind, with its axes scaled by `factors`."""
    if kind == "ball":
        solid = trimesh.creation.icosphere(subdivisions=5)
    elif kind == "box":
        solid = trimesh.creation.box((1.0, 1.0, 1.0))
    else:
        solid = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=128)
        solid.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return Triangles(np.asarray(solid.vertices) * factors, np.asarray(solid.faces))


def fit_proportions(
    mesh: Mesh, targets: Sequence[Target], states: Sequence[PoseState], steps: int, free: Float[np.ndarray, "3 k"] = BOX
) -> tuple[Factors, float]:
    """Fit factors of product 1 and states together by Gauss–Newton, starting from the mesh as it is.

    Args:
        mesh: The mesh.
        targets: Windows about the masks of the photos.
        states: Initial state in each photo.
        steps: Greatest number of steps.
        free: Directions in which the logarithms of the factors may move.

    Returns:
        Factors and mean score of the best step.
    """
    shape = np.zeros(free.shape[1])
    best = np.ones(3), -np.inf
    jacobian = partial(jacobian_with_shape, free=free)
    for k in range(steps + 1):
        factors = np.exp(free @ shape)
        caster = Caster(scale_mesh(mesh, tuple(factors)))
        renderings = [render(caster, target, state) for target, state in zip(targets, states, strict=True)]
        if (score := float(np.mean([rendering.score for rendering in renderings]))) > best[1]:
            best = factors, score
        if k == steps:
            break
        equations = [normal_equations(rendering, jacobian) for rendering in renderings]
        by_shape, moves = _joint_step(equations, [target.view.free for target in targets])
        shape = shape + by_shape
        states = [state.apply_step(move) for state, move in zip(states, moves, strict=True)]
        if np.abs(by_shape).max(initial=0.0) < STILL:
            break
    return best


def jacobian_with_shape(
    state: PoseState, arms: Float[np.ndarray, "n 3"], free: Float[np.ndarray, "3 k"] = BOX
) -> Float[np.ndarray, "n 2 m"]:
    """Return the derivative of image points (photo pixels) by the unknowns of `PoseState.apply_step` and of the shape.

    Args:
        state: State of the mesh.
        arms: Offsets of surface points from the mesh's centre, camera axes.
        free: Directions in which the logarithms of the factors may move.

    Returns:
        A matrix for each point, m = 7 + k.
    """
    # R e_k e_kᵀ Rᵀ a, the move of a surface point by log s_k, times the directions of d
    moves = np.einsum("dk,nk,kj->ndj", state.rotation, arms @ state.rotation, free)
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
    shared = FACTOR_DAMPING * np.eye(count)
    pull = np.zeros(count)
    eliminated = []
    for (information, gradient), k in zip(equations, free, strict=True):
        matrix = information + np.diag(np.append(DAMPING, np.zeros(count)))
        cross = matrix[:k, 7:]
        away = np.linalg.solve(matrix[:k, :k], np.column_stack([cross, gradient[:k]]))
        shared = shared + information[7:, 7:] - cross.T @ away[:, :count]
        pull = pull + gradient[7:] - cross.T @ away[:, count]
        eliminated.append(away)
    # the step of d, then the photos' own steps by back-substitution
    by_shape = np.clip(-np.linalg.solve(shared, pull), -LARGEST_STEP, LARGEST_STEP)
    moves = []
    for away in eliminated:
        move = np.clip(-away[:, count] - away[:, :count] @ by_shape, -2 * LARGEST_STEP, 2 * LARGEST_STEP)
        moves.append(np.append(move, np.zeros(7 - len(move))))
    return by_shape, moves
