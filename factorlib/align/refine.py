"""Refinement of a pose on contours, by Gauss–Newton.

Every step renders the contour of the mesh to a fraction of a pixel. Rays are bisected between a pixel inside and one
outside. (With whole pixels most residuals are exactly 0, and a robust fit sticks to them.) To first order the image of
an occluding contour moves, across itself, as the surface points on it do. So the 3D point of each contour point carries
the derivative. COLMAP's absolute pose refinement on the same correspondences, measured on real photos, ends in the same
place. There are two kinds of residual, both in window pixels and both per material, so that the border between two
parts counts too:

    mesh → mask    the mask's signed distance at each contour point of the mesh
    mask → mesh    the distance along the mask's normal from each of its contour points to the mesh's nearest one

The first kind alone lets a mesh hide inside its mask, the second alone lets it stick out. Cauchy weights, with a scale
from the residuals themselves, limit the influence of parts that only one of the two has.
"""

from collections.abc import Callable

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from factorlib.align.silhouette import labelled_iou
from factorlib.align.state import PoseState
from factorlib.align.target import Target, border_pairs
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster, Hits
from factorlib.robust import robust_deviation

CORRELATION = 10.0  # number of contour pixels that share one error of mask or mesh
LEAST_SPREAD = 0.35  # error of a mask's contour, which follows whole pixels; in window pixels
HALVINGS = 3  # bisections of a pixel, to locate the mesh's contour
MOST_SCALE = 0.05  # greatest scale of the residuals, as a share of the mask's extent
DAMPING = np.array([0.15, 0.15, 0.15, 0.1, 0.1, 0.15, 0.3]) ** -2.0  # inverse variance of a step of each unknown
LARGEST_STEP = 0.3  # greatest step of each unknown, in its unit
STILL = 0.03  # a step of fewer standard errors ends the iteration
Points = Float[np.ndarray, "n 2"]


class RefinedState(msgspec.Struct, frozen=True):
    """State, its labelled IoU in the window, and the information matrix of the normal equations there."""

    state: PoseState
    score: float
    information: Float[np.ndarray, "7 7"]

    def log_focal_sigma(self) -> float:
        """Return the standard error of the log focal length by the normal equations, prior included."""
        return float(np.sqrt(max(np.linalg.pinv(self.information)[6, 6], 0.0)))


class Rendering(msgspec.Struct, frozen=True):
    """Mesh in a state, rendered in a target's window: the camera of the window, and the hits of its pixels' rays."""

    caster: Caster
    target: Target
    state: PoseState
    window: Camera
    hits: Hits

    @property
    def score(self) -> float:
        """Labelled IoU with the target's mask."""
        return labelled_iou(self.target.silhouette, self.caster.labels(self.hits))


def render(caster: Caster, target: Target, state: PoseState) -> Rendering:
    """Cast the mesh in `state` into the target's window of the photo."""
    window = target.window(state.focal)
    return Rendering(caster, target, state, window, caster.cast(window, state.pose(caster)))


def refine(caster: Caster, target: Target, start: PoseState, steps: int) -> RefinedState:
    """Refine `start` by Gauss–Newton and return the state of the best score.

    It ends early if a step is short or if three steps in a row gain nothing.

    Args:
        caster: The mesh.
        target: Window about the mask.
        start: Initial state.
        steps: Greatest number of steps.

    Returns:
        The best of all states on the way, `start` included.
    """
    state = start
    free = target.view.free
    visited: list[RefinedState] = []
    for _ in range(steps + 1):
        rendering = render(caster, target, state)
        information, gradient = normal_equations(rendering)
        visited.append(RefinedState(state, rendering.score, information))
        # damped Gauss–Newton step of the free unknowns
        step = np.zeros(7)
        step[:free] = -np.linalg.solve((information + np.diag(DAMPING))[:free, :free], gradient[:free])
        step = np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        scores = [result.score for result in visited]
        if step @ information @ step < STILL**2 or max(scores[-3:]) < max(scores):
            break
        state = state.moved(step)
    return max(visited, key=lambda result: result.score)


def normal_equations(
    rendering: Rendering, image_jacobian: Callable[..., np.ndarray] = PoseState.jacobian
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Return information matrix and gradient of the contours' residuals, robustly weighted, prior included.

    Args:
        rendering: The rendered mesh.
        image_jacobian: Derivative of image points by all unknowns, from the state and the points' offsets, as
            `PoseState.jacobian`.

    Returns:
        Information and gradient; the first seven unknowns are those of `PoseState.moved`.
    """
    target = rendering.target
    state = rendering.state
    view = target.view
    residuals = [np.zeros(0)]
    rows = [np.zeros((0, image_jacobian(state, np.zeros((0, 3))).shape[-1]))]
    for label, region in target.regions.items():
        points, arms = mesh_contour(rendering, label)
        if len(points) == 0:
            continue
        # mesh → mask: signed distance, and its slope times the Jacobian of the image points
        jacobian = image_jacobian(state, arms) / target.pixel
        slope_x, slope_y = (interpolate(region.slope[..., k], points)[:, None] for k in (0, 1))
        residuals.append(interpolate(region.distance, points))
        rows.append(slope_x * jacobian[:, 0] + slope_y * jacobian[:, 1])
        # mask → mesh: distance along the mask's normal to the nearest contour point of the mesh
        if len(region.contour):
            nearest = cKDTree(points).query(region.contour)[1]
            residuals.append(np.einsum("nd,nd->n", region.outward, points[nearest] - region.contour))
            rows.append(np.einsum("nd,ndk->nk", region.outward, jacobian[nearest]))
    # Cauchy weights 1/(1 + (r/2s)²) of scale s, over the variance of CORRELATION pixels
    residual = np.concatenate(residuals)
    row = np.concatenate(rows)
    scale = max(min(robust_deviation(residual) if len(residual) else 0.0, MOST_SCALE * target.extent), LEAST_SPREAD)
    weight = 1 / (1 + (residual / (2 * scale)) ** 2) / (CORRELATION * scale**2)
    # information JᵀWJ and gradient JᵀWr, with the prior of log focal length
    information = (row * weight[:, None]).T @ row
    gradient = row.T @ (weight * residual)
    if view.focal_sigma > 0:
        information[6, 6] += view.focal_sigma**-2
        gradient[6] += (state.log_focal - np.log(view.camera.focal)) / view.focal_sigma**2
    return information, gradient


def mesh_contour(rendering: Rendering, label: int) -> tuple[Points, Float[np.ndarray, "n 3"]]:
    """Return the contour of the mesh's part of that label and the surface points that move it.

    Where another part covers this one, the contour moves with the nearer surface.

    Returns:
        Points (x, y) of the contour in window pixels, and offsets from the mesh's centre to their surface points
        (camera axes, mesh units).
    """
    caster = rendering.caster
    window = rendering.window
    hits = rendering.hits
    inside = caster.labels(hits) == label
    pixel_in, pixel_out = border_pairs(inside, ~inside)
    depth = np.minimum(hits.depth[tuple(pixel_in.T)], hits.depth[tuple(pixel_out.T)])
    near = pixel_in[:, ::-1] + 0.5
    far = pixel_out[:, ::-1] + 0.5
    pose = rendering.state.pose(caster)
    # bisect between the pixel inside and the pixel outside
    for _ in range(HALVINGS):
        middle = (near + far) / 2
        within = (caster.labels(caster.cast_along(window.rays_through(middle), pose)) == label)[:, None]
        near = np.where(within, middle, near)
        far = np.where(within, far, middle)
    points = (near + far) / 2
    return points, window.rays_through(points) * depth[:, None] - rendering.state.middle()


def interpolate(image: Float[np.ndarray, "h w"], points: Points) -> Float[np.ndarray, " n"]:
    """Return an image's values at points (x, y), pixel centres at 0.5, by bilinear interpolation."""
    return map_coordinates(image, points.T[::-1] - 0.5, order=1, mode="nearest")
