"""A pose moved by shading and contours together: Gauss-Newton with the light's weights eliminated.

    photometric    r_ic(θ, w) = (Σ_p w_pc B_ipc(θ) − radiance_ic)/σ_ic        θ: turn 3, place 3, focal length
    contours       the normal equations of `factorlib.align.refine`

The residual is linear in w.  With A = ∂r/∂w over the lobes of positive weight and J = ∂r/∂θ, elimination of w leaves

    H = JᵀWJ − JᵀWA (AᵀWA)⁻¹ AᵀWJ,        g = JᵀWr − JᵀWA (AᵀWA)⁻¹ AᵀWr                                        (1)

(Golub and Pereyra's variable projection in Kaufman's form).  Without the elimination the pose would hardly move, for the light was
fitted to the present pose.  J is a central difference over normals of poses a little to either side; pixels near an edge are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.align.refine import CORRELATION, FocalPrior, normal_equations, rendered
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State
from factorlib.align.target import Target, target_of
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.refine.light import Surfaces, pursued_light, robust_loss, robust_scale, with_weights
from factorlib.refine.pixels import View

RESOLUTION, MARGIN = 300, 0.1  # of the window that contours are compared in, as of `factorlib.align.target`
ASIDE = np.array([0.008, 0.008, 0.008, 0.002, 0.002, 0.008, 0.02])  # steps of the differences: radians, slopes, logs
EDGE_TURN = 0.97  # cosine: normals that differ more on the two sides belong to two surfaces
DAMPING = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.1, 0.3]) ** -2.0  # as if each unknown had a deviation of its own
Rows = Bool[np.ndarray, " m"]
LARGEST_STEP = 0.1  # of each unknown, in its own unit


class Moving(msgspec.Struct, frozen=True):
    """The object that moves: its mesh, what its contours are compared with, how surfaces reflect, and the photo's observations.

    block: observations of all pixels with the object in a given state, and which of them show the material that the mask says
    """

    caster: Caster
    target: Target
    camera: Camera
    prior: FocalPrior
    surfaces: Surfaces
    block: Callable[[State, Block | None], tuple[Block, Rows]]

    def score(self, state: State) -> float:
        """Labelled IoU."""
        return rendered(self.caster, self.target, self.camera, state).score(self.target)


def moving_object(
    view: View,
    number: int,
    camera: Camera,
    silhouette: Silhouette,
    prior: FocalPrior,
    poses: Sequence[Pose],
    surfaces: Surfaces,
) -> Moving:
    """Object `number` of a photo, its others staying at their `poses`; prior: what is known of the focal length."""
    caster = view.casters[number]

    def block(state: State, like: Block | None) -> tuple[Block, Rows]:
        """All pixels with the object in a state, visibility as in `like`; which of them show what the mask does."""
        own, posed = state.camera(camera), [*poses[:number], state.pose(caster), *poses[number + 1 :]]
        seen = view.seen(own, posed)
        return view.block(own, seen, like, posed), seen.agrees

    target = target_of(silhouette, caster.mesh.labels, RESOLUTION, MARGIN)
    return Moving(caster, target, camera, prior, surfaces, block)


def descended(moving: Moving, start: State, steps: int, most_lost: float) -> State:
    """The state, of those met in `steps` steps from `start`, whose fitted pixels are explained best while the labelled
    IoU is at most `most_lost` below that of the start."""
    state, best, least, floor = start, start, np.inf, moving.score(start) - most_lost
    every, light, surfaces = None, None, moving.surfaces
    for k in range(steps + 1):
        every, agrees = moving.block(state, every)  # visibility hardly changes on the way
        rows = agrees & ~every.held_out
        fit = every.take(rows)
        if len(fit) == 0:
            break
        light = pursued_light(fit, surfaces) if k in (0, steps // 2) else with_weights(surfaces.under(light, fit))
        lit = surfaces.under(light, fit)
        residual = lit.residuals()
        if k == 0:
            robust = robust_loss(residual)
        loss = float(robust.of_residuals(residual).mean())
        if loss < least and moving.score(state) >= floor:
            best, least = state, loss
        if k < steps:
            state = state.moved(_step(moving, state, every, rows, lit, residual))
    return best


def _step(
    moving: Moving, state: State, every: Block, rows: Rows, lit: Illumination, residual: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "7"]:
    """The step of a state.

    every: all pixels with the object in the state;  rows: which of them are fitted
    lit:   the fitted pixels in their light, whose whitened residual is `residual`
    """
    seen = rendered(moving.caster, moving.target, moving.camera, state)
    (by_contours, pull), free = normal_equations(seen, moving.target, moving.prior), moving.prior.free
    jacobian = photometric_jacobian(moving, state, every, rows, lit.light, free)
    information, gradient = projected_equations(jacobian, residual, lit)
    hessian = by_contours[:free, :free] + information + np.diag(DAMPING[:free])
    step = np.zeros(7)
    step[:free] = -np.linalg.solve(hessian, pull[:free] + gradient)
    return np.clip(step, -LARGEST_STEP, LARGEST_STEP)


def photometric_jacobian(
    moving: Moving, state: State, every: Block, rows: Rows, light: Light, free: int
) -> Float[np.ndarray, "n 3 k"]:
    """∂r/∂θ at the n pixels that are fitted, by the first `free` of θ, by central differences; 0 where the two sides show
    different surfaces."""
    result, surfaces = np.zeros((int(rows.sum()), 3, free)), moving.surfaces
    for k in range(free):
        (low, low_agrees), (high, high_agrees) = (
            moving.block(state.moved(sign * ASIDE[k] * np.eye(7)[k]), every) for sign in (-1, 1)
        )
        low, high = low.take(rows), high.take(rows)
        smooth = (low_agrees & high_agrees)[rows] & (np.sum(low.normal * high.normal, axis=1) > EDGE_TURN)
        difference = surfaces.under(light, high).radiance() - surfaces.under(light, low).radiance()
        result[..., k] = np.where(smooth[:, None], difference * low.precision / (2 * ASIDE[k]), 0.0)
    return result


def projected_equations(
    jacobian: Float[np.ndarray, "n 3 k"], residual: Float[np.ndarray, "n 3"], lit: Illumination
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """H and g of equation (1), over the residuals' own spread and their correlation."""
    light = lit.light
    atoms = lit.atoms(np.arange(len(lit.block)), light.unit_lobes)
    scale, k = robust_scale(residual), jacobian.shape[-1]
    trust = robust_loss(residual).trust(residual)
    hessian, gradient = np.zeros((k, k)), np.zeros(k)
    for c in range(3):
        shining = atoms[c][:, light.weight[:, c] > 0]
        j, a, w = jacobian[:, c], shining, trust[:, c, None]
        gram = (w * a).T @ a
        gram += 1e-6 * np.diag(np.diag(gram)) + 1e-12 * np.eye(len(gram))
        cross = (w * j).T @ a
        away = np.linalg.solve(gram, cross.T).T
        hessian += (w * j).T @ j - away @ cross.T
        gradient += (w * j).T @ residual[:, c] - away @ ((w * a).T @ residual[:, c])
    variance = CORRELATION * (scale / 3) ** 2
    return hessian / variance, gradient / variance
