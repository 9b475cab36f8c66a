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

from factorlib.align.refine import FocalPrior
from factorlib.align.search import Search, find, found_near
from factorlib.align.state import state_of
from factorlib.align.target import target_of
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
RIM = 0.02  # share of the largest radius: thinner ends are cut off
SEARCH = Search(views=200, keep=(24, 8, 4, 2))
log = logging.getLogger("factorlib.shapes")

Profile = Float[np.ndarray, "n 2"]  # (height, radius), by ascending height


class Turned(msgspec.Struct, frozen=True):
    """Body of revolution in a photo: profile, cam_from_body, camera of its fit, and overlap (IoU) with the outline."""

    profile: Profile
    pose: Pose
    camera: Camera
    overlap: float
    tilt_deg: float = 0.0


def body_of_revolution(outlines: Sequence[Outline], report: Callable[[float], None] = lambda share: None) -> Triangles:
    """Compute the body of revolution that all outlines show.

    Args:
        outlines: Outlines of the object.
        report: Function of the share that is done.

    Returns:
        The mesh, in the frame of the poses if they are given, else centred at the origin.

    Raises:
        InputError: If no photo shows the object completely enough to determine its axis.
    """
    outlines = sorted(map(_without_holes, outlines), key=lambda one: -int((one.part > 0).sum()))
    given = [Turned(np.zeros((0, 2)), one.pose, one.camera, 0.0) for one in outlines if one.pose is not None]
    if given:
        known = [one for one in outlines if one.pose is not None]
        shape = mesh_of(carved_by_all(known, given, _span(known, given)))
        return msgspec.structs.replace(shape, overlap=overlap(shape, known))
    begun = []
    for one in outlines[:REFERENCES]:
        turned = sorted(tilted(one), key=lambda each: -each.overlap)
        if turned:
            good = [each for each in turned if each.overlap >= turned[0].overlap - AS_GOOD]
            begun.append((one, _spread(good)))
    if not begun:
        cure = (
            "does a photo show the whole outline, from the side, cut by nothing? Leave out by 255 what is in front of "
            "it"
        )
        raise InputError("no outline is mirrored onto itself, as that of a body of revolution is", cure=cure)
    if len(outlines) == 1:
        one, turned = begun[0]
        log.warning(
            "%s: one outline does not say how the axis is tilted: the strongest tilt that explains it is taken; "
            "a second photo from another height says it",
            one.photo,
        )
        best = max(turned, key=lambda each: abs(each.tilt_deg))
        return msgspec.structs.replace(mesh_of(best.profile).of_size(1.0), overlap=best.overlap)
    poses = _tilt_chosen(begun, outlines[:JUDGES], report)
    profile = poses[0].profile
    poses += [laid_on(one, profile) for one in outlines[JUDGES:]]
    for k in range(ROUNDS):
        report(0.8 + 0.2 * k / ROUNDS)
        profile = carved_by_all(outlines, poses, (profile[0, 0], profile[-1, 0]))
        poses = [laid_on(one, profile, pose) for one, pose in zip(outlines, poses, strict=True)]
    shown = float(np.mean([pose.overlap for pose in poses]))
    return msgspec.structs.replace(mesh_of(profile).of_size(1.0), overlap=shown)


def _without_holes(one: Outline) -> Outline:
    """Fill holes of the outline, such as a highlight that a mask lacks; no body of revolution has holes."""
    return msgspec.structs.replace(one, part=np.where(binary_fill_holes(one.part) & (one.part == 0), 1, one.part))


class Laid(msgspec.Struct, frozen=True):
    """Body from the outline `of` at one tilt, and its poses in all judging photos."""

    of: Outline
    begun: Turned
    poses: list[Turned]

    @property
    def overlap(self) -> float:
        """Mean IoU over the judging photos."""
        return float(np.mean([pose.overlap for pose in self.poses]))


def _tilt_chosen(
    begun: Sequence[tuple[Outline, Sequence[Turned]]], judges: Sequence[Outline], report: Callable[[float], None]
) -> list[Turned]:
    """Choose the body whose tilt explains the outlines best and return its poses in the judging photos.

    A warning is logged if a wide range of tilts explains the outlines alike. `begun` holds outlines and bodies of
    different tilts that explain each.
    """
    tried = [(one, each) for one, turned in begun for each in turned]
    laid = []
    for done, (one, each) in enumerate(tried):
        report(0.7 * done / len(tried))
        laid.append(Laid(one, each, [each if other is one else laid_on(other, each.profile) for other in judges]))
    best = max(laid, key=lambda each: each.overlap)
    for turn in FINER_DEG:
        pose = best.begun.pose
        tilt = best.begun.tilt_deg + turn
        tilted = _at_tilt(best.of, best.begun.camera, pose.rotation[:, 0], pose.translation, tilt)
        if tilted is not None:
            near = zip(judges, best.poses, strict=True)
            poses = [tilted if one is best.of else laid_on(one, tilted.profile, pose) for one, pose in near]
            laid.append(Laid(best.of, tilted, poses))
    best = max(laid, key=lambda each: each.overlap)
    alike = [e.begun.tilt_deg for e in laid if e.of is best.of and e.overlap >= best.overlap - AS_GOOD]
    if max(alike) - min(alike) > UNTOLD_DEG:
        log.warning(
            "%s: tilts of the axis from %.0f to %.0f° explain the outlines alike, so its profile is not sure: a photo "
            "from higher up, or from lower down, says it",
            best.of.photo,
            min(alike),
            max(alike),
        )
    return best.poses


def _spread(turned: Sequence[Turned]) -> list[Turned]:
    """Select at most TRIED bodies, evenly over their tilts."""
    ordered = sorted(turned, key=lambda each: each.tilt_deg)
    return [ordered[k] for k in np.unique(np.linspace(0, len(ordered) - 1, TRIED).round().astype(int))]


def tilted(one: Outline) -> Iterator[Turned]:
    """Yield the largest body that fits, for each mirror plane of the outline and each tilt in it."""
    camera = msgspec.structs.replace(one.camera, focal=one.prior.focal)
    for normal in mirrors(one, camera):
        ray = camera.rays_through(one.middle[None])[0]
        ahead = ray - (ray @ normal) * normal
        yield from filter(None, (_at_tilt(one, camera, normal, ahead, float(tilt)) for tilt in TILTS_DEG))


def _at_tilt(
    one: Outline, camera: Camera, normal: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"], tilt_deg: float
) -> Turned | None:
    """Return the largest body about an axis through `ahead` in the plane of that normal; None if none fits."""
    ahead = ahead / np.linalg.norm(ahead)
    tilt = np.deg2rad(tilt_deg)
    axis = np.cos(tilt) * np.cross(normal, ahead) + np.sin(tilt) * ahead
    pose = Pose(np.stack([normal, axis, np.cross(normal, axis)], axis=1), ahead)
    view = Turned(np.zeros((0, 2)), pose, camera, 0.0, tilt_deg)
    profile = carved_by_all([one], [view], _span([one], [view]))
    if len(profile) < 3:
        return None
    return msgspec.structs.replace(view, profile=profile, overlap=overlap(mesh_of(profile), [at(one, view)]))


def mirrors(one: Outline, camera: Camera) -> list[Float[np.ndarray, "3"]]:
    """Find the normals of planes through the camera that mirror the outline onto itself, best first."""
    # a random sample of the outline's rays, and a frame about their mean
    target = target_of(one.silhouette, (1,), 200)
    rows, columns = np.nonzero(one.part > 0)
    some = np.random.default_rng(0).permutation(len(rows))[:3000]
    rays = camera.rays_through(np.column_stack([columns[some], rows[some]]) + 0.5)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ray = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    x = np.cross([0.0, 1.0, 0.0], ray)
    x /= np.linalg.norm(x)
    y = np.cross(ray, x)
    spread = np.arctan(target.extent * target.pixel / 2 / camera.focal)

    def normal(angle: float, offset: float) -> np.ndarray:
        """Return the normal of the plane through the middle ray, moved aside by `offset` half extents."""
        across = np.cos(angle) * x + np.sin(angle) * y
        return across * np.cos(offset * spread) + ray * np.sin(offset * spread)

    def outside(plane: np.ndarray) -> float:
        """Return the mean squared distance by which mirrored rays leave the outline, in pixels of a window of 200."""
        n = normal(*plane)
        mirrored = rays - 2 * (rays @ n)[:, None] * n
        if (mirrored[:, 2] <= 0).any():
            return 1e6
        return float(np.mean(np.minimum(one.inner(camera.project(mirrored)), 0.0) ** 2)) / target.pixel**2

    # a grid over angle and offset, then Nelder–Mead from its best local minima
    angles = np.arange(MIRRORS) * np.pi / MIRRORS
    least = [min((outside(np.array([angle, off])), off) for off in np.linspace(-0.3, 0.3, 7)) for angle in angles]
    cost = np.array([value for value, _ in least])
    minima = [k for k in range(MIRRORS) if cost[k] <= min(cost[k - 1], cost[(k + 1) % MIRRORS])]
    starts = sorted(minima, key=lambda k: cost[k])[:4]
    options = {"xatol": 1e-4, "fatol": 1e-5}
    found = [minimize(outside, [angles[k], least[k][1]], method="Nelder-Mead", options=options) for k in starts]
    good = [each for each in found if each.fun <= max(MIRRORED_PX**2, 4 * min(each.fun for each in found))]
    if not good or min(each.fun for each in good) > 4 * MIRRORED_PX**2:
        return []
    return [normal(*each.x) for each in sorted(good, key=lambda each: each.fun)[:2]]


def _span(outlines: Sequence[Outline], poses: Sequence[Turned]) -> tuple[float, float]:
    """Return the range of heights on the axis in which the axis lies inside all outlines.

    It contains the body, because the centre of every disc lies inside the outlines.
    """
    lows: list[float] = []
    highs: list[float] = []
    for one, view in zip(outlines, poses, strict=True):
        distance = float(np.linalg.norm(view.pose.translation))
        half = distance * 4 * one.silhouette.inside.sum() ** 0.5 / view.camera.focal
        heights = np.linspace(-half, half, 1001)
        points = view.pose.apply(np.column_stack([0 * heights, heights, 0 * heights]))
        ahead = points[:, 2] > 1e-3 * distance
        inner = one.inner(view.camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0])))
        held = heights[ahead & (inner > 0) & (inner < 1e8)]
        if len(held):
            lows, highs = [*lows, held.min()], [*highs, held.max()]
    return (max(lows), min(highs)) if lows else (0.0, 0.0)


def carved_by_all(outlines: Sequence[Outline], poses: Sequence[Turned], span: tuple[float, float]) -> Profile:
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
    radius = np.min([largest_discs(one, view, heights) for one, view in zip(outlines, poses, strict=True)], axis=0)
    used = np.flatnonzero(radius > RIM * radius.max())
    if len(used) < 5:
        return np.zeros((0, 2))
    part = slice(used[0], used[-1] + 1)
    # smoothing spline whose residuals are those of the masks' contours
    pixel = min(float(np.linalg.norm(view.pose.translation)) / view.camera.focal for view in poses)
    spline = UnivariateSpline(heights[part], radius[part], s=len(used) / len(poses) * (MASK_ERROR * pixel) ** 2)
    return np.column_stack([heights[part], np.maximum(spline(heights[part]), RIM * radius.max())])


def largest_discs(one: Outline, view: Turned, heights: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return r(z) of (1) for one outline, in the body's units.

    Args:
        one: The outline.
        view: Camera and pose of the body.
        heights: Heights z of the discs.

    Returns:
        A radius for each height.
    """
    pose = view.pose
    camera = view.camera
    distance = float(np.linalg.norm(pose.translation))
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    most = distance * 2 * one.silhouette.inside.sum() ** 0.5 / camera.focal + 1e-9
    around = np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    low = np.zeros(len(heights))
    high = np.full(len(heights), most)
    centres = np.column_stack([0 * heights, heights, 0 * heights])
    # the first radius at which a point leaves the outline, on a grid, then on a finer grid within its cell
    for _ in range(2):
        share = np.arange(RADII + 1) / RADII
        radii = low[:, None] + share * (high - low)[:, None]
        points = centres[:, None, None] + radii[..., None, None] * around
        seen = points @ pose.rotation.T + pose.translation
        ahead = seen[..., 2] > 1e-3 * distance
        pixels = camera.project(np.where(ahead[..., None], seen, [0.0, 0.0, 1.0]))
        left = ((one.inner(pixels) < 0) | ~ahead).any(axis=-1)
        left[:, -1] = True
        first = left.argmax(axis=1)
        rows = np.arange(len(heights))
        low = radii[rows, np.maximum(first - 1, 0)]
        high = radii[rows, first]
    return np.where(first == 0, 0.0, low)


def mesh_of(profile: Profile) -> Triangles:
    """Mesh the body of a profile, closed by a disc at each end.

    Raises:
        InputError: If the profile has fewer than three heights.
    """
    if len(profile) < 3:
        cure = "are its masks and poses of the same object, and is it turned about the y of its poses?"
        raise InputError("no body of revolution fits into its outlines", cure=cure)
    angle = np.arange(COLUMNS) * 2 * np.pi / COLUMNS
    height = profile[::-1, :1]  # by descending height
    radius = profile[::-1, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.sin(angle), height, radius * np.cos(angle)), axis=-1)
    mesh = closed_grid(points, np.array([0, height[0, 0], 0]), np.array([0, height[-1, 0], 0]))
    return Triangles(mesh.vertices, mesh.faces)


def at(one: Outline, view: Turned) -> Outline:
    """Return the outline with the camera and the pose of a body's fit."""
    return msgspec.structs.replace(one, camera=view.camera, pose=view.pose)


def laid_on(one: Outline, profile: Profile, near: Turned | None = None) -> Turned:
    """Fit the pose of the body to an outline.

    Args:
        one: The outline.
        profile: Profile of the body.
        near: Initial pose and focal length; None searches all poses.

    Returns:
        The body with its pose, camera and overlap.
    """
    caster = Caster(mesh_of(profile).as_mesh())
    camera = one.camera
    prior = one.prior
    if near is None:
        found = find(caster, one.silhouette, camera, prior, SEARCH)
    else:
        known = FocalPrior(near.camera.focal, prior.sigma)
        found = found_near(caster, one.silhouette, near.camera, state_of(near.pose, near.camera, caster), known, SEARCH)
    return Turned(profile, found.state.pose(caster), found.state.camera(camera), found.score)
