"""Body of revolution from its outlines.

The plane through the camera and the body's axis mirrors the body onto itself, so it mirrors the outline's rays onto
themselves. A search over two numbers finds that plane. In it the axis is tilted by an angle θ, which one outline does
not determine. Given θ, the body is the largest that fits: at each height the largest disc about the axis whose image
lies inside the outline,

    r(z) = max { r : the image of the disc (z, r) ⊂ outline },                                                   (1)

a visual hull among bodies of revolution. The other photos determine θ: the body of each tilt is fitted to their
outlines, and the body that agrees best is kept. A single photo does not determine θ. Then the strongest tilt that
explains its outline is taken, because ends of real bodies are more often flat than round. Finally the radii are carved
again from all outlines. The axis is the shape's y.
"""

import logging
from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.interpolate import UnivariateSpline
from scipy.ndimage import binary_fill_holes
from scipy.optimize import minimize

from factorlib.align.refine import pose_state
from factorlib.align.search import SearchOptions, estimate_pose, refine_near
from factorlib.align.silhouette import make_target
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster
from factorlib.meshes.mesh import closed_grid
from factorlib.shapes.hull import overlap
from factorlib.shapes.outline import Outline, Triangles

HEIGHTS = 96  # number of discs
AROUND = 48  # number of points of each disc
RADII = 80  # number of radii tried for each disc
TILTS_DEG = np.arange(-75.0, 76.0, 5.0)
MIRRORS = 36  # number of directions of the mirror plane tried
MIRRORED_PX = 1.5  # error of mirrored points, in pixels of an outline of 200 pixels
AS_GOOD = 0.006  # tilts of a smaller difference in overlap (IoU) are equally good
REFERENCES = 2  # number of photos that bodies are carved from
TRIED = 5  # number of tilts tried for each of them
JUDGES = 4  # number of photos that the body of each tilt is fitted to
FINER_DEG = (-7.5, -5.0, -2.5, 2.5, 5.0, 7.5)  # further tilts tried, from the best one
UNTOLD_DEG = 12.0  # a wider range of equally good tilts gives a warning
MASK_ERROR = 0.2  # error of a mask's contour, pixels
ROUNDS = 2  # number of alternations of carving and fitting poses
COLUMNS = 96  # number of the mesh's vertices about the axis
REVOLVED = 0.97  # least IoU of an outline and the best body of revolution from it alone that it is taken for
RIM = 0.02  # share of the largest radius: thinner ends are cut off
SEARCH = SearchOptions(views=200, keep=(24, 8, 4, 2))
log = logging.getLogger("factorlib.shapes")

Profile = Float[np.ndarray, "n 2"]  # (height, radius), by ascending height
NO_PROFILE = np.zeros((0, 2))


class BodyView(msgspec.Struct, frozen=True):
    """Body of revolution in a photo.

    profile   radii by height
    pose      cam_from_body
    camera    camera of the fit, with its focal length
    overlap   IoU with the outline
    tilt_deg  assumed tilt of the axis, degrees
    """

    profile: Profile
    pose: Pose
    camera: Camera
    overlap: float = 0.0
    tilt_deg: float = 0.0


class TiltTrial(msgspec.Struct, frozen=True):
    """Body of revolution computed from one outline for an assumed tilt of its axis.

    outline  the outline
    body     the body and its pose in that photo
    poses    its fitted poses in the photos by which tilts are compared
    """

    outline: Outline
    body: BodyView
    poses: list[BodyView]

    @property
    def overlap(self) -> float:
        """Mean IoU over the photos by which tilts are compared."""
        return float(np.mean([pose.overlap for pose in self.poses]))


def body_of_revolution(outlines: Sequence[Outline], report: Callable[[float], None] = lambda share: None) -> Triangles:
    """Compute the body of revolution that all outlines show.

    Args:
        outlines: Outlines of the object.
        report: Called with the completed share, from 0 to 1.

    Returns:
        The mesh, in the frame of the poses if they are given, else centred at the origin.

    Raises:
        InputError: If no photo shows the object completely enough to determine its axis.
    """
    outlines = sorted(map(_fill_holes, outlines), key=lambda outline: -int((outline.part > 0).sum()))
    if posed := [outline for outline in outlines if outline.pose is not None]:
        poses = [BodyView(NO_PROFILE, outline.known_pose, outline.camera) for outline in posed]
        shape = mesh_profile(carve(posed, poses, _axis_range(posed, poses)))
        return msgspec.structs.replace(shape, overlap=overlap(shape, posed))
    starts = [(outline, bodies) for outline in outlines[:REFERENCES] if (bodies := _plausible_bodies(outline))]
    if not starts:
        raise InputError(
            "no outline is mirror-symmetric, as that of a body of revolution must be",
            cure=(
                "add a photo that shows the whole outline from the side; give pixels of whatever hides the object the "
                "label 255"
            ),
        )
    if len(outlines) == 1:
        log.warning(
            "%s: one outline does not determine the tilt of the axis: the strongest tilt that explains it is taken; "
            "add a second photo from another height",
            outlines[0].photo,
        )
        best = max(starts[0][1], key=lambda body: abs(body.tilt_deg))
        return msgspec.structs.replace(mesh_profile(best.profile).with_size(1.0), overlap=best.overlap)
    poses = _choose_tilt(starts, outlines[:JUDGES], report)
    profile = poses[0].profile
    poses += [fit_pose(outline, profile) for outline in outlines[JUDGES:]]
    for k in range(ROUNDS):
        report(0.8 + 0.2 * k / ROUNDS)
        profile = carve(outlines, poses, (profile[0, 0], profile[-1, 0]))
        poses = [fit_pose(outline, profile, pose) for outline, pose in zip(outlines, poses, strict=True)]
    mean_overlap = float(np.mean([pose.overlap for pose in poses]))
    return msgspec.structs.replace(mesh_profile(profile).with_size(1.0), overlap=mean_overlap)


def is_revolved(outline: Outline) -> bool:
    """Return True if a body of revolution of some tilt explains an outline."""
    return any(body.overlap >= REVOLVED for body in _bodies(_fill_holes(outline), TILTS_DEG[::3]))


def _fill_holes(outline: Outline) -> Outline:
    """Fill holes of the outline, such as a highlight that a mask lacks; no body of revolution has holes."""
    filled = np.where(binary_fill_holes(outline.part) & (outline.part == 0), 1, outline.part)
    return msgspec.structs.replace(outline, part=filled)


def _bodies(outline: Outline, tilts: Float[np.ndarray, " t"] = TILTS_DEG) -> Iterator[BodyView]:
    """Yield the largest body that fits for each mirror plane of the outline and each tilt in it, upright ones first."""
    for normal in mirror_planes(outline):
        ray = outline.camera.rays_through(outline.middle[None])[0]
        ahead = ray - (ray @ normal) * normal
        for tilt in sorted(tilts, key=abs):
            if body := _body_at_tilt(outline, normal, ahead, float(tilt)):
                yield body


def _plausible_bodies(outline: Outline) -> list[BodyView]:
    """Return at most TRIED bodies that explain the outline as well as the best one, evenly over their tilts."""
    bodies = list(_bodies(outline))
    bodies.sort(key=lambda body: -body.overlap)
    plausible = [body for body in bodies if body.overlap >= bodies[0].overlap - AS_GOOD]
    ordered = sorted(plausible, key=lambda body: body.tilt_deg)
    # indices spread evenly, without repetition
    indices = np.unique(np.linspace(0, len(ordered) - 1, TRIED).round().astype(int))
    return [ordered[k] for k in indices] if ordered else []


def _choose_tilt(
    starts: Sequence[tuple[Outline, Sequence[BodyView]]], judges: Sequence[Outline], report: Callable[[float], None]
) -> list[BodyView]:
    """Choose the body whose tilt explains the outlines best and return its poses in the photos of `judges`.

    A warning is logged if a wide range of tilts explains the outlines alike. `starts` holds outlines and bodies of
    different tilts that explain each.
    """
    bodies = [(outline, body) for outline, candidates in starts for body in candidates]
    trials = []
    for index, (outline, body) in enumerate(bodies):
        report(0.7 * index / len(bodies))
        poses = [body if judge is outline else fit_pose(judge, body.profile) for judge in judges]
        trials.append(TiltTrial(outline, body, poses))
    best = max(trials, key=lambda trial: trial.overlap)
    # finer tilts about the best one, from its poses
    for change in FINER_DEG:
        pose = best.body.pose
        finer = _body_at_tilt(best.outline, pose.rotation[:, 0], pose.translation, best.body.tilt_deg + change)
        if finer is not None:
            near = zip(judges, best.poses, strict=True)
            poses = [finer if judge is best.outline else fit_pose(judge, finer.profile, start) for judge, start in near]
            trials.append(TiltTrial(best.outline, finer, poses))
    best = max(trials, key=lambda trial: trial.overlap)
    similar = [
        trial.body.tilt_deg
        for trial in trials
        if trial.outline is best.outline and trial.overlap >= best.overlap - AS_GOOD
    ]
    if max(similar) - min(similar) > UNTOLD_DEG:
        log.warning(
            "%s: tilts of the axis from %.0f to %.0f° explain the outlines alike, so its profile is uncertain: add a "
            "photo from higher up or from lower down",
            best.outline.photo,
            min(similar),
            max(similar),
        )
    return best.poses


def _body_at_tilt(
    outline: Outline, normal: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"], tilt_deg: float
) -> BodyView | None:
    """Return the largest body about an axis through `ahead` in the plane of that normal; None if none fits."""
    ahead = ahead / np.linalg.norm(ahead)
    tilt = np.deg2rad(tilt_deg)
    axis = np.cos(tilt) * np.cross(normal, ahead) + np.sin(tilt) * ahead
    pose = Pose(np.stack([normal, axis, np.cross(normal, axis)], axis=1), ahead)
    body = BodyView(NO_PROFILE, pose, outline.camera, tilt_deg=tilt_deg)
    profile = carve([outline], [body], _axis_range([outline], [body]))
    if len(profile) < 3:
        return None
    posed = msgspec.structs.replace(outline, pose=pose)
    return msgspec.structs.replace(body, profile=profile, overlap=overlap(mesh_profile(profile), [posed]))


def mirror_planes(outline: Outline) -> list[Float[np.ndarray, "3"]]:
    """Find the normals of planes through the camera that mirror the outline onto itself, best first."""
    # a random sample of the outline's rays, and a frame about their mean
    camera = outline.camera
    target = make_target(outline.view, (1,), 200)
    rows, columns = np.nonzero(outline.part > 0)
    sample = np.random.default_rng(0).permutation(len(rows))[:3000]
    rays = camera.rays_through(np.column_stack([columns[sample], rows[sample]]) + 0.5)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ray = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    x = np.cross([0.0, 1.0, 0.0], ray)
    x /= np.linalg.norm(x)
    y = np.cross(ray, x)
    spread = np.arctan(target.extent * target.pixel / 2 / camera.focal)

    def normal(angle: float, offset: float) -> np.ndarray:
        """Return the normal of the plane through the middle ray, moved aside by `offset` half extents."""
        return (np.cos(angle) * x + np.sin(angle) * y) * np.cos(offset * spread) + ray * np.sin(offset * spread)

    def outside(plane: np.ndarray) -> float:
        """Return the mean squared distance by which mirrored rays leave the outline, in pixels of a window of 200."""
        n = normal(*plane)
        mirrored = rays - 2 * (rays @ n)[:, None] * n
        if (mirrored[:, 2] <= 0).any():
            return 1e6
        return float(np.mean(np.minimum(outline.inner(camera.project(mirrored)), 0.0) ** 2)) / target.pixel**2

    # a grid over angle and offset, then Nelder–Mead from its best local minima
    angles = np.arange(MIRRORS) * np.pi / MIRRORS
    least = [min((outside(np.array([angle, off])), off) for off in np.linspace(-0.3, 0.3, 7)) for angle in angles]
    cost = np.array([value for value, _ in least])
    minima = [k for k in range(MIRRORS) if cost[k] <= min(cost[k - 1], cost[(k + 1) % MIRRORS])]
    starts = sorted(minima, key=lambda k: cost[k])[:4]
    options = {"xatol": 1e-4, "fatol": 1e-5}
    planes = [minimize(outside, [angles[k], least[k][1]], method="Nelder-Mead", options=options) for k in starts]
    planes.sort(key=lambda plane: plane.fun)
    if not planes or planes[0].fun > 4 * MIRRORED_PX**2:
        return []
    return [normal(*plane.x) for plane in planes[:2] if plane.fun <= max(MIRRORED_PX**2, 4 * planes[0].fun)]


def _axis_range(outlines: Sequence[Outline], poses: Sequence[BodyView]) -> tuple[float, float]:
    """Return the range of heights on the axis in which the axis lies inside all outlines.

    It contains the body, because the centre of every disc lies inside the outlines.
    """
    lows: list[float] = []
    highs: list[float] = []
    for outline, body in zip(outlines, poses, strict=True):
        distance = float(np.linalg.norm(body.pose.translation))
        half = distance * 4 * (outline.part > 0).sum() ** 0.5 / body.camera.focal
        heights = np.linspace(-half, half, 1001)
        points = body.pose.apply(np.column_stack([0 * heights, heights, 0 * heights]))
        ahead = points[:, 2] > 1e-3 * distance
        inner = outline.inner(body.camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0])))
        inside = heights[ahead & (inner > 0) & (inner < 1e8)]
        if len(inside):
            lows.append(inside.min())
            highs.append(inside.max())
    return (max(lows), min(highs)) if lows else (0.0, 0.0)


def carve(outlines: Sequence[Outline], poses: Sequence[BodyView], span: tuple[float, float]) -> Profile:
    """Return the profile of the largest discs that fit into every outline, smoothed as far as pixels allow.

    Ends of negligible radius are cut off.

    Args:
        outlines: Outlines of the object.
        poses: Camera and pose of the body for each outline.
        span: Lowest and highest height.

    Returns:
        The profile; empty if no body fits.
    """
    low, high = span
    if not high > low:
        return np.zeros((0, 2))
    heights = low + (np.arange(HEIGHTS) + 0.5) / HEIGHTS * (high - low)
    pairs = zip(outlines, poses, strict=True)
    radius = np.min([largest_discs(outline, body, heights) for outline, body in pairs], axis=0)
    used = np.flatnonzero(radius > RIM * radius.max())
    if len(used) < 5:
        return np.zeros((0, 2))
    part = slice(used[0], used[-1] + 1)
    # smoothing spline whose residuals are those of the masks' contours
    pixel = min(float(np.linalg.norm(body.pose.translation)) / body.camera.focal for body in poses)
    spline = UnivariateSpline(heights[part], radius[part], s=len(used) / len(poses) * (MASK_ERROR * pixel) ** 2)
    return np.column_stack([heights[part], np.maximum(spline(heights[part]), RIM * radius.max())])


def largest_discs(outline: Outline, body: BodyView, heights: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the radii r(z) of (1) of the largest discs that fit into one outline, in the body's units.

    Args:
        outline: The outline.
        body: Camera and pose of the body.
        heights: Heights z of the discs.

    Returns:
        A radius for each height.
    """
    pose = body.pose
    camera = body.camera
    distance = float(np.linalg.norm(pose.translation))
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    most = distance * 2 * (outline.part > 0).sum() ** 0.5 / camera.focal + 1e-9
    around = np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    low = np.zeros(len(heights))
    high = np.full(len(heights), most)
    centres = np.column_stack([0 * heights, heights, 0 * heights])
    # the first radius at which a point leaves the outline, on a grid, then on a finer grid within its cell
    for _ in range(2):
        radii = low[:, None] + (np.arange(RADII + 1) / RADII) * (high - low)[:, None]
        points = centres[:, None, None] + radii[..., None, None] * around
        in_camera = points @ pose.rotation.T + pose.translation
        ahead = in_camera[..., 2] > 1e-3 * distance
        pixels = camera.project(np.where(ahead[..., None], in_camera, [0.0, 0.0, 1.0]))
        outside = ((outline.inner(pixels) < 0) | ~ahead).any(axis=-1)
        outside[:, -1] = True
        first = outside.argmax(axis=1)
        rows = np.arange(len(heights))
        low = radii[rows, np.maximum(first - 1, 0)]
        high = radii[rows, first]
    return np.where(first == 0, 0.0, low)


def mesh_profile(profile: Profile) -> Triangles:
    """Mesh the body of a profile, closed by a disc at each end.

    Raises:
        InputError: If the profile has fewer than three heights.
    """
    if len(profile) < 3:
        raise InputError(
            "no body of revolution fits into its outlines",
            cure="check that its masks and poses belong to one object, which is round about the y axis of its poses",
        )
    angle = np.arange(COLUMNS) * 2 * np.pi / COLUMNS
    height = profile[::-1, :1]  # by descending height
    radius = profile[::-1, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.sin(angle), height, radius * np.cos(angle)), axis=-1)
    mesh = closed_grid(points, np.array([0, height[0, 0], 0]), np.array([0, height[-1, 0], 0]))
    return Triangles(mesh.vertices, mesh.faces)


def fit_pose(outline: Outline, profile: Profile, near: BodyView | None = None) -> BodyView:
    """Fit the pose of the body to an outline.

    Args:
        outline: The outline.
        profile: Profile of the body.
        near: Initial pose and focal length; None searches all poses.

    Returns:
        The body with its pose, camera and overlap.
    """
    caster = Caster(mesh_profile(profile).as_mesh())
    if near is None:
        estimate = estimate_pose(caster, outline.view, SEARCH)
    else:
        view = msgspec.structs.replace(outline.view, camera=near.camera)
        estimate = refine_near(caster, view, pose_state(near.pose, near.camera, caster), SEARCH)
    return BodyView(profile, estimate.state.pose(caster), estimate.state.camera(outline.camera), estimate.score)
