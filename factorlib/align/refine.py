"""Refinement of a pose on contours, by Gauss-Newton.

The contour of the mesh in the image is rendered anew at every step, to a fraction of a pixel: between a pixel in and
one out, rays are halved in.  (With whole pixels most residuals are exactly 0, and a robust fit sticks to them.)  To
first order the image of an occluding contour moves, across itself, as the surface points on it do; so each contour
point's 3D point carries the derivative.  COLMAP's absolute pose refinement on the same correspondences, measured on
real photos, ends in the same place.
Two kinds of residual, both in window pixels and both per material, so that the border between two parts counts too:

    mesh → mask    the mask's signed distance at each contour point of the mesh
    mask → mesh    how far, along the mask's normal, the nearest contour point of the mesh is from each one of the mask

The first alone lets a mesh hide inside its mask, the second alone lets it stick out.  Cauchy weights with a scale
from the residuals themselves keep parts that one of the two lacks from pulling.
"""

from collections.abc import Callable

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from factorlib.align.silhouette import labelled_iou
from factorlib.align.state import State
from factorlib.align.target import Target, border_pairs
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster, Hits
from factorlib.robust import robust_deviation

CORRELATION = 10.0  # contour pixels that share one error of mask or mesh
LEAST_SPREAD = 0.35  # window pixels: the error of a mask's contour, of whole pixels as it is
HALVINGS = 3  # of a pixel, to find where the mesh's contour crosses it
MOST_SCALE = 0.05  # of the mask's extent
DAMPING = np.array([0.15, 0.15, 0.15, 0.1, 0.1, 0.15, 0.3]) ** -2.0  # as if each unknown had a deviation of its own
LARGEST_STEP = 0.3  # of each unknown, in its own unit
STILL = 0.03  # standard errors, by the normal equations: a shorter step ends the descent
Points = Float[np.ndarray, "n 2"]


class FocalPrior(msgspec.Struct, frozen=True):
    """log focal length ~ Normal(log `focal`, `sigma`); sigma 0: known."""

    focal: float
    sigma: float

    @property
    def free(self) -> int:
        """The number of unknowns of `State.moved` that may move: the last is the focal length."""
        return 7 if self.sigma > 0 else 6


class Refined(msgspec.Struct, frozen=True):
    """A state, its labelled IoU in the window, and the information of the normal equations there."""

    state: State
    score: float
    information: Float[np.ndarray, "7 7"]

    def log_focal_sigma(self) -> float:
        """Standard error of the log focal length by the normal equations, the prior included."""
        return float(np.sqrt(max(np.linalg.pinv(self.information)[6, 6], 0.0)))


class Rendered(msgspec.Struct, frozen=True):
    """A mesh in a state, as a target's window sees it: the camera of the window, and what its pixels' rays hit."""

    caster: Caster
    state: State
    window: Camera
    hits: Hits

    def score(self, target: Target) -> float:
        """Labelled IoU with the target's mask."""
        return labelled_iou(target.silhouette, self.caster.labels(self.hits))


def rendered(caster: Caster, target: Target, camera: Camera, state: State) -> Rendered:
    """The mesh in `state`, cast in the target's window of the photo with camera `camera`."""
    window = target.camera(state.camera(camera))
    return Rendered(caster, state, window, caster.cast(window, state.pose(caster)))


def refined(caster: Caster, target: Target, camera: Camera, start: State, prior: FocalPrior, steps: int) -> Refined:
    """The best-scoring state met in `steps` steps from `start`; fewer where a step is short, or three in a row gain nothing."""
    state, free = start, prior.free
    ran: list[Refined] = []
    for _ in range(steps + 1):
        seen = rendered(caster, target, camera, state)
        information, gradient = normal_equations(seen, target, prior)
        ran.append(Refined(state, seen.score(target), information))
        step = np.zeros(7)
        step[:free] = -np.linalg.solve((information + np.diag(DAMPING))[:free, :free], gradient[:free])
        step = np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        scores = [result.score for result in ran]
        if step @ information @ step < STILL**2 or max(scores[-3:]) < max(scores):
            break
        state = state.moved(step)
    return max(ran, key=lambda result: result.score)


def normal_equations(
    seen: Rendered, target: Target, prior: FocalPrior, jacobian_of: Callable[..., np.ndarray] = State.jacobian
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Information and gradient of the contours' residuals by all unknowns, the first seven those of `State.moved`, robustly
    weighted, with the prior of the focal length.

    jacobian_of: derivative of image points by all unknowns, from the state and the points' arms, as `State.jacobian`
    """
    residuals, rows = [np.zeros(0)], [np.zeros((0, jacobian_of(seen.state, np.zeros((0, 3))).shape[-1]))]
    for name, region in target.regions.items():
        points, arms = contour_of(seen, name)
        if len(points) == 0:
            continue
        jacobian = jacobian_of(seen.state, arms) / target.pixel
        slope_x, slope_y = (at_points(region.slope[..., k], points)[:, None] for k in (0, 1))
        residuals.append(at_points(region.distance, points))
        rows.append(slope_x * jacobian[:, 0] + slope_y * jacobian[:, 1])
        if len(region.contour):
            nearest = cKDTree(points).query(region.contour)[1]
            residuals.append(np.einsum("nd,nd->n", region.outward, points[nearest] - region.contour))
            rows.append(np.einsum("nd,ndk->nk", region.outward, jacobian[nearest]))
    residual, row = np.concatenate(residuals), np.concatenate(rows)
    scale = max(min(robust_deviation(residual) if len(residual) else 0.0, MOST_SCALE * target.extent), LEAST_SPREAD)
    weight = 1 / (1 + (residual / (2 * scale)) ** 2) / (CORRELATION * scale**2)
    information, gradient = (row * weight[:, None]).T @ row, row.T @ (weight * residual)
    if prior.sigma > 0:
        information[6, 6] += prior.sigma**-2
        gradient[6] += (seen.state.log_focal - np.log(prior.focal)) / prior.sigma**2
    return information, gradient


def contour_of(seen: Rendered, name: int) -> tuple[Points, Float[np.ndarray, "n 3"]]:
    """Points (x, y) of the contour of the mesh's part of label `name`, window pixels, and the arms from the mesh's centre
    to the surface points that move them (camera axes, mesh units): where another part covers it, the contour moves with
    the nearer surface.
    """
    caster, window, hits = seen.caster, seen.window, seen.hits
    inside = caster.labels(hits) == name
    pixel_in, pixel_out = border_pairs(inside, ~inside)
    depth = np.minimum(hits.depth[tuple(pixel_in.T)], hits.depth[tuple(pixel_out.T)])
    near, far, pose = pixel_in[:, ::-1] + 0.5, pixel_out[:, ::-1] + 0.5, seen.state.pose(caster)
    for _ in range(HALVINGS):
        middle = (near + far) / 2
        within = (caster.labels(caster.cast_along(window.rays_through(middle), pose)) == name)[:, None]
        near, far = np.where(within, middle, near), np.where(within, far, middle)
    points = (near + far) / 2
    return points, window.rays_through(points) * depth[:, None] - seen.state.middle()


def at_points(image: Float[np.ndarray, "h w"], points: Points) -> Float[np.ndarray, " n"]:
    """An image's values at points (x, y), pixel centres at 0.5, linear between pixels."""
    return map_coordinates(image, points.T[::-1] - 0.5, order=1, mode="nearest")
