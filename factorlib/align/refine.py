"""Pose and focal length as seven numbers that are nearly independent in an image, and their refinement on contours.

Refinement is Gauss–Newton.

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

from factorlib.align.silhouette import Target, border_pairs, labelled_iou
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster, Hits
from factorlib.meshes.mesh import Mesh
from factorlib.robust import robust_deviation

GENERATORS = np.cross(np.eye(3)[:, None], np.eye(3))  # of rotations; [k, i, j]: component j of e_k × e_i
CORRELATION = 10.0  # number of contour pixels that share one error of mask or mesh
LEAST_SPREAD = 0.35  # error of a mask's contour, which follows whole pixels; in window pixels
HALVINGS = 3  # bisections of a pixel, to locate the mesh's contour
MOST_SCALE = 0.05  # greatest scale of the residuals, as a share of the mask's extent
DAMPING = np.array([0.15, 0.15, 0.15, 0.1, 0.1, 0.15, 0.3]) ** -2.0  # inverse variance of a step of each unknown
LARGEST_STEP = 0.3  # greatest step of each unknown, in its unit
STILL = 0.03  # a step of fewer standard errors ends the iteration
Points = Float[np.ndarray, "n 2"]


class PoseState(msgspec.Struct, frozen=True):
    """Pose of a mesh by its rotation and the position of its centre, with the focal length.

    rotation   cam_from_object             a, b       slopes of the ray to the mesh's centre: x/z, y/z
    log_depth  of the centre, mesh units   log_focal  photo pixels
    """

    rotation: Float[np.ndarray, "3 3"]
    a: float
    b: float
    log_depth: float
    log_focal: float

    def middle(self) -> Float[np.ndarray, "3"]:
        """Return the mesh's centre in camera coordinates, mesh units."""
        return np.exp(self.log_depth) * np.array([self.a, self.b, 1.0])

    def pose(self, mesh: Mesh | Caster) -> Pose:
        """Return cam_from_object, the pose that puts the mesh's centre at `middle()`."""
        return Pose(self.rotation, self.middle() - self.rotation @ mesh.centre)

    @property
    def focal(self) -> float:
        """Focal length, photo pixels."""
        return float(np.exp(self.log_focal))

    def camera(self, template: Camera) -> Camera:
        """Return the camera `template` with this state's focal length."""
        return msgspec.structs.replace(template, focal=self.focal)

    def apply_step(self, step: Float[np.ndarray, "7"]) -> "PoseState":
        """Return the state moved by `step`: rotation vector in camera axes (3), a, b, log depth, log focal.

        A step of log focal changes depth and slopes as well, so that size and place in the image stay.
        """
        zoom = step[6]
        a = float((self.a + step[3]) * np.exp(-zoom))
        b = float((self.b + step[4]) * np.exp(-zoom))
        log_depth = float(self.log_depth + step[5] + zoom)
        return PoseState(rotation_of_vector(step[:3]) @ self.rotation, a, b, log_depth, float(self.log_focal + zoom))

    def jacobian(self, arms: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 7"]:
        """Return the derivative of image points (photo pixels) by the step of `apply_step`, [n, 2, 7].

        `arms` are the points' offsets from the centre, in camera axes.
        """
        depth = np.exp(self.log_depth)
        focal = np.exp(self.log_focal)
        point = arms + self.middle()
        # moves of the points in camera axes by a, b, log depth, log focal, and by rotation about axis k (e_k × arm)
        shifts = depth * np.array([[1, 0, self.a, 0], [0, 1, self.b, 0], [0, 0, 1, 1]])
        turns = np.moveaxis(arms @ GENERATORS, 0, -1)
        moves = np.concatenate([turns, np.broadcast_to(shifts, (len(arms), 3, 4))], axis=-1)
        # derivative of the perspective projection; log focal also scales the image
        slope = point[:, :2] / point[:, 2:]
        result = (moves[:, :2] - slope[:, :, None] * moves[:, 2:]) * (focal / point[:, 2])[:, None, None]
        result[:, :, 6] += focal * slope
        return result


def pose_state(pose: Pose, camera: Camera, mesh: Mesh | Caster) -> PoseState:
    """Return the state of a mesh's pose, the inverse of `PoseState.pose`.

    Args:
        pose: Pose of the mesh.
        camera: Camera, for its focal length.
        mesh: The mesh, for its centre.

    Returns:
        The state.
    """
    x, y, z = pose.apply(mesh.centre[None])[0]
    return PoseState(pose.rotation, float(x / z), float(y / z), float(np.log(z)), float(np.log(camera.focal)))


class RefinedState(msgspec.Struct, frozen=True):
    """Refined state, its labelled IoU in the target's window, and the information matrix of its normal equations."""

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
        state = state.apply_step(step)
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
        Information and gradient; the first seven unknowns are those of `PoseState.apply_step`.
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
