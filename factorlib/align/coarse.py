"""Initial poses by template matching: every view of the mesh, at every roll, laid on the mask at every place.

The number of wrong pixels of a template T (one image per material l) laid on the mask at a shift t is linear in T,

    errors(t) = |mask| + Σ_l Σ_p T_l(p − t) E_l(p),     E_l = +1 on background, −1 on material l, 0 elsewhere.   (1)

E_l is also 0 where nothing is known: on pixels left out or hidden, and outside the frame. So one correlation by FFT
gives the errors of all shifts. Views are spread evenly over the sphere (Fibonacci), rolls are rotations of the photo,
and the size follows from the areas. The areas do not give the size where the frame or an occluder cuts the mask;
several sizes are tried there.
"""

from collections.abc import Iterator

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.fft import irfft2, rfft2

from factorlib.align.refine import PoseState
from factorlib.align.silhouette import ObjectView, Silhouette, bounding_box
from factorlib.geometry.camera import Camera, rotation_of_vector
from factorlib.geometry.raster import Caster
from factorlib.geometry.sphere import fibonacci_sphere

GRID = 64  # side of the templates, pixels
WHOLE = 29  # extent of a whole mask, grid pixels
CUT = 21  # extent of a cut mask, grid pixels
SIZES_OF_WHOLE = (0.95, 1.05)  # relative to the size that the areas give
SIZES_OF_CUT = (0.95, 1.15, 1.4, 1.75, 2.2)
CUT_SHARE = 0.03  # a mask is cut if more of its contour is at the frame or at broad unknown areas
BROAD = 0.03  # share of the mask's extent: narrower unknown bands, as along a contour, hide nothing
Rotation = Float[np.ndarray, "3 3"]


class TemplateMatch(msgspec.Struct, frozen=True):
    """Placement of a template on the photo.

    error   wrong pixels, as a share of the mask's
    turn    rotation of the view: it takes the direction of view to the optical axis
    roll    rotation about the optical axis that undoes the photo's rotation
    shift   (x, y) of the template, grid pixels
    focal   focal length, grid pixels
    """

    error: float
    turn: Rotation
    roll: Rotation
    shift: Int[np.ndarray, "2"]
    focal: float


def rotation_to_axis(direction: Float[np.ndarray, "3"]) -> Rotation:
    """Return the smallest rotation that takes `direction`, unit and not (0, 0, −1), to the optical axis."""
    x, y, z = direction
    near = 1 + z
    return np.array([[1 - x * x / near, -x * y / near, -x], [-x * y / near, 1 - y * y / near, -y], [x, y, z]])


def is_cut(silhouette: Silhouette) -> bool:
    """Return whether the frame, left-out pixels or other objects hide a substantial part of the mask's contour."""
    reach = max(int(BROAD * bounding_box(silhouette)[2] / 2), 1)
    pad = 2 * reach + 2
    # unknown pixels, also beyond the frame, by morphological opening without bands narrower than 2 · reach
    unknown = np.pad(~silhouette.known, pad, constant_values=True)
    unknown = ndimage.distance_transform_edt(~(ndimage.distance_transform_edt(unknown) > reach)) <= reach + 1
    inside = np.pad(silhouette.inside, pad)
    border = inside & ~ndimage.binary_erosion(inside)
    return bool(np.count_nonzero(border & unknown) > CUT_SHARE * np.count_nonzero(border))


def initial_states(
    caster: Caster, view: ObjectView, views: int, rolls: int, keep: int, apart_deg: float
) -> list[PoseState]:
    """Return the best initial states that differ in rotation, best first.

    Args:
        caster: The mesh.
        view: The mask, with at least one pixel of the object, and the camera.
        views: Number of directions of view, spread evenly over the sphere.
        rolls: Number of rotations of the photo, spread evenly over 360°.
        keep: Greatest number of states.
        apart_deg: Least angle of rotation between any two states, degrees.

    Returns:
        States, best first.
    """
    camera = view.camera
    matches, middle, pixel, distance = match_templates(caster, view, views, rolls)
    states = []
    for match in _select_distinct(matches, keep, apart_deg):
        # undo shift and roll: slopes of the ray to the object's centre, and the log depth
        slope = (middle + pixel * match.roll[:2, :2] @ match.shift - np.array(camera.centre)) / camera.focal
        log_depth = np.log(camera.focal * distance / (match.focal * pixel))
        rotation = rotation_to_ray(slope) @ match.roll @ match.turn
        states.append(PoseState(rotation, *map(float, (*slope, log_depth, np.log(camera.focal)))))
    return states


def match_templates(
    caster: Caster, view: ObjectView, views: int, rolls: int
) -> tuple[list[TemplateMatch], np.ndarray, float, float]:
    """Return the best placement of the mesh for each direction of view, roll and size.

    Args:
        caster: The mesh.
        view: The mask, with at least one pixel of the object, and the camera.
        views: Number of directions of view, spread evenly over the sphere.
        rolls: Number of rotations of the photo, spread evenly over 360°.

    Returns:
        The matches, the mask's centre (x, y) in photo pixels, the size of a grid pixel in photo pixels, and the
        distance from which the templates are rendered, in units of the mesh.
    """
    silhouette = view.silhouette
    low, high, extent = bounding_box(silhouette)
    cut = is_cut(silhouette)
    pixel = extent / (CUT if cut else WHOLE)
    middle = (low + high) / 2
    angles = np.arange(rolls) * 2 * np.pi / rolls
    area = np.count_nonzero(silhouette.inside) / pixel**2
    # spectra of E_l for every roll
    costs = _cost_images(silhouette, caster.mesh.labels, middle, pixel, angles)
    spectra = rfft2(costs, axes=(-2, -1)).astype(np.complex64)  # [rolls, labels, GRID, GRID//2+1]
    matches = []
    inverse_rolls = rotation_of_vector(np.outer(-angles, [0, 0, 1]))
    distance = np.clip(view.camera.focal / (extent / 2), 2.5, 30.0) * caster.radius
    for direction in fibonacci_sphere(views):
        turn = rotation_to_axis(direction)
        for template, focal in _templates(caster, turn, distance, area, SIZES_OF_CUT if cut else SIZES_OF_WHOLE):
            # Σ_l Σ_p T_l(p − t) E_l(p) of (1) for every shift t, by correlation; the best shift of every roll
            spectrum = rfft2(template, axes=(-2, -1)).astype(np.complex64)
            errors = irfft2((spectra * np.conj(spectrum)).sum(axis=1), s=(GRID, GRID), axes=(-2, -1)).reshape(rolls, -1)
            best = errors.argmin(axis=1)
            error = 1 + errors[np.arange(rolls), best] / area
            shift = (np.stack([best % GRID, best // GRID], axis=1) + GRID // 2) % GRID - GRID // 2
            matches += [TemplateMatch(error[k], turn, inverse_rolls[k], shift[k], focal) for k in range(rolls)]
    return matches, middle, pixel, distance


def _cost_images(
    silhouette: Silhouette, labels: tuple[int, ...], middle: np.ndarray, pixel: float, angles: np.ndarray
) -> Float[np.ndarray, "rolls labels GRID GRID"]:
    """Return E_l of (1) for the photo rotated by each angle about `middle`."""
    # average E_l over blocks of step × step pixels, so that thin parts count by their area
    step = max(int(pixel / 2), 1)
    height, width = (-(-n // step) * step for n in silhouette.label.shape)
    means = []
    for label in labels:
        cost = np.zeros((height, width))
        pixel_costs = np.where(silhouette.label == 0, 1.0, np.where(silhouette.label == label, -1.0, 0.0))
        cost[: len(pixel_costs), : pixel_costs.shape[1]] = pixel_costs
        means.append(cost.reshape(height // step, step, width // step, step).mean(axis=(1, 3)))
    # sample it on the grid rotated about the centre
    offset = np.arange(GRID) + 0.5 - GRID / 2
    x, y = np.meshgrid(offset * pixel, offset * pixel)
    images = np.empty((len(angles), len(labels), GRID, GRID), np.float32)
    for k, angle in enumerate(angles):
        cos = np.cos(angle)
        sin = np.sin(angle)
        position = [(middle[1] - sin * x + cos * y) / step - 0.5, (middle[0] + cos * x + sin * y) / step - 0.5]
        for n, image in enumerate(means):
            images[k, n] = ndimage.map_coordinates(image, position, order=1, cval=0.0)
    return images


def _templates(
    caster: Caster, turn: Rotation, distance: float, area: float, sizes: tuple[float, ...]
) -> Iterator[tuple[Float[np.ndarray, "labels GRID GRID"], float]]:
    """Yield label images of the mesh at each size and the focal length (grid pixels) of each.

    The images are scaled about the centre by nearest-neighbour sampling.
    """
    pose = PoseState(turn, 0.0, 0.0, np.log(distance), 0.0).pose(caster)
    focal = 0.48 * GRID * distance / caster.radius
    image = caster.labels(caster.cast(Camera(GRID, GRID, focal, (GRID / 2, GRID / 2)), pose))
    for size in sizes:
        zoom = np.sqrt(area / max(int(np.count_nonzero(image)), 1)) * size
        if zoom < 4:  # otherwise the mesh is seen edge-on and cannot be the mask
            index = np.floor((np.arange(GRID) + 0.5 - GRID / 2) / zoom + GRID / 2).astype(int)
            inside = (index >= 0) & (index < GRID)
            index = np.clip(index, 0, GRID - 1)
            resized = np.where(inside[:, None] & inside, image[np.ix_(index, index)], 0)
            yield np.stack([resized == label for label in caster.mesh.labels]).astype(np.float32), focal * zoom


def _select_distinct(matches: list[TemplateMatch], keep: int, apart_deg: float) -> list[TemplateMatch]:
    """Select the best matches such that none is within `apart_deg` of a better one."""
    order = np.argsort(np.array([match.error for match in matches]), kind="stable")[: 60 * keep]
    rotations = np.stack([matches[k].roll @ matches[k].turn for k in order])
    selected: list[TemplateMatch] = []
    # tr RᵢᵀRⱼ = 1 + 2 cos(angle)
    closest = 1 + 2 * np.cos(np.deg2rad(apart_deg))
    free = np.ones(len(order), bool)
    while free.any() and len(selected) < keep:
        k = int(np.argmax(free))
        selected.append(matches[order[k]])
        free &= np.einsum("nij,ij->n", rotations, rotations[k]) < closest
        free[k] = False
    return selected


def rotation_to_ray(slope: Float[np.ndarray, "2"]) -> Rotation:
    """Return the smallest rotation that takes the optical axis to the ray (slope, 1)."""
    ray = np.array([*slope, 1.0])
    return rotation_to_axis(ray / np.linalg.norm(ray)).T
