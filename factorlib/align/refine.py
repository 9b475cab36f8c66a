"""Refinement of a pose on contours, by Gauss-Newton.

The contour of the mesh in the image is rendered anew at every step.  To first order the image of an occluding contour
moves, across itself, as the surface points on it do; so each contour pixel's 3D point carries the derivative.
Two kinds of residual, both in window pixels and both per material, so that the border between two parts counts too:

    mesh → mask    the mask's signed distance at each contour pixel of the mesh
    mask → mesh    how far, along the mask's normal, the nearest contour pixel of the mesh is from each one of the mask

The first alone lets a mesh hide inside its mask, the second alone lets it stick out.  Cauchy weights with a scale
from the residuals themselves keep parts that one of the two lacks from pulling.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from factorlib.align.camera import Camera
from factorlib.align.evidence import labelled_iou
from factorlib.align.raster import Caster, Hits
from factorlib.align.state import State
from factorlib.align.target import Region, Target, _has_neighbour

CORRELATION = 10.0  # contour pixels that share one error of mask or mesh
LEAST_SCALE = 0.35  # window pixels: the error of a contour pixel's place
MOST_SCALE = 0.05  # of the mask's extent


class FocalPrior(msgspec.Struct, frozen=True):
    """log focal length ~ Normal(log `focal`, `sigma`); sigma 0: known."""

    focal: float
    sigma: float


class Refined(msgspec.Struct, frozen=True):
    """A state, its labelled IoU in the window, the residuals' scale (window pixels) and the normal equations there."""

    state: State
    score: float
    scale: float
    information: Float[np.ndarray, "7 7"]

    def log_focal_sigma(self) -> float:
        """Standard error of the log focal length by the normal equations, the prior included."""
        return float(np.sqrt(max(np.linalg.pinv(self.information)[6, 6], 0.0)))


def refined(caster: Caster, target: Target, camera: Camera, start: State, prior: FocalPrior, steps: int) -> Refined:
    """The best-scoring state met in `steps` steps from `start`."""
    state, best = start, None
    failures = 0
    for k in range(steps + 1):
        window = target.camera(state.camera(camera))
        hits = caster.cast(window, state.pose(caster))
        label = np.where(hits.face >= 0, caster.mesh.face_label[hits.face], 0)
        score = labelled_iou(target.evidence, label)
        equations = normal_equations(target, window, hits, label, state, prior)
        if best is None or score > best.score:
            best, failures = Refined(state, score, equations.scale, equations.information), 0
        else:
            failures += 1
        if k == steps or failures > 4:
            break
        step = equations.step(prior.sigma > 0)
        state = state.moved(step)
        if np.abs(step).max() < 2e-5:
            break
    return best


class Equations(msgspec.Struct, frozen=True):
    information: Float[np.ndarray, "7 7"]
    gradient: Float[np.ndarray, "7"]
    scale: float

    def step(self, move_focal: bool) -> Float[np.ndarray, "7"]:
        """Damped Gauss-Newton step: as if each number had a standard deviation of its own about where it is."""
        free = 7 if move_focal else 6
        damping = np.array([0.15, 0.15, 0.15, 0.1, 0.1, 0.15, 0.3]) ** -2.0
        step = np.zeros(7)
        step[:free] = -np.linalg.solve((self.information + np.diag(damping))[:free, :free], self.gradient[:free])
        return np.clip(step, -0.3, 0.3)


def normal_equations(
    target: Target, window: Camera, hits: Hits, label: Int[np.ndarray, "h w"], state: State, prior: FocalPrior
) -> Equations:
    residuals, rows = [np.zeros(0)], [np.zeros((0, 7))]
    for name, region in target.regions.items():
        pixels, arms = contour_of(label, name, hits, window, state)
        if len(pixels) == 0:
            continue
        jacobian = state.jacobian(arms) / target.pixel
        for residual, row in (_mesh_to_mask(region, pixels, jacobian), _mask_to_mesh(region, pixels, jacobian)):
            residuals.append(residual)
            rows.append(row)
    residual, row = np.concatenate(residuals), np.concatenate(rows)
    spread = 1.4826 * np.median(np.abs(residual)) if len(residual) else LEAST_SCALE
    scale = float(np.clip(spread, LEAST_SCALE, MOST_SCALE * target.extent))
    weight = 1 / (1 + (residual / (2 * scale)) ** 2) / (CORRELATION * scale**2)
    information, gradient = (row * weight[:, None]).T @ row, row.T @ (weight * residual)
    if prior.sigma > 0:
        information[6, 6] += prior.sigma**-2
        gradient[6] += (state.log_focal - np.log(prior.focal)) / prior.sigma**2
    return Equations(information, gradient, scale)


def contour_of(
    label: Int[np.ndarray, "h w"], name: int, hits: Hits, window: Camera, state: State
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]]:
    """Centres (x, y) of the rendered region's border pixels, and the arms from the mesh's centre to the points that move them.

    Where another part covers the region, the border moves with the nearer surface.
    """
    inside = label == name
    border = np.zeros(label.shape, bool)
    border[1:-1, 1:-1] = inside[1:-1, 1:-1] & _has_neighbour(~inside)
    rows, columns = np.nonzero(border)
    depth = hits.depth
    nearest = np.minimum.reduce([depth[rows, columns], *(depth[rows + i, columns + j] for i, j in ((-1, 0), (1, 0), (0, -1), (0, 1)))])
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    rays = np.concatenate([(pixels - np.array(window.centre)) / window.focal, np.ones((len(pixels), 1))], axis=1)
    return pixels, rays * nearest[:, None] - state.middle()


def _mesh_to_mask(region: Region, pixels: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    column, row = pixels.astype(int).T
    distance, slope = region.distance[row, column], region.slope[row, column]
    # a border pixel that agrees lies half a pixel inside; unknown pixels are a dead zone
    residual = np.where(distance == 0, 0.0, distance + 0.5)
    return residual, np.einsum("nd,ndk->nk", slope, jacobian)


def _mask_to_mesh(region: Region, pixels: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if len(region.contour) == 0:
        return np.zeros(0), np.zeros((0, 7))
    nearest = cKDTree(pixels).query(region.contour)[1]
    residual = np.einsum("nd,nd->n", region.outward, pixels[nearest] - region.contour)
    return residual, np.einsum("nd,ndk->nk", region.outward, jacobian[nearest])
