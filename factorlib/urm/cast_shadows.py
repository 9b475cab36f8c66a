"""Observations of the ground about the objects of a photo: their shadows tell where its light comes from.

The light on a point of the ground is that of the directions which the objects do not hide from it (Sato, Sato and
Ikeuchi, "Illumination from shadows", 2003).  The ground is divided into square patches.  A patch has the median
radiance of its pixels, and the mean visibility of some of them: both are averages over the patch.

Grounds have patterns, things stand on them, and near lamps make one side brighter.  Let r be the log radiance of a
patch.  A polynomial of its place is fitted to the less shadowed half of the patches, robustly, and taken away: the rest
is the log of the radiance relative to that without shadows.  The degree is the least, at most `MOST_DEGREE`, that
leaves a spread of `EVEN`.  A patch that is brighter by more than `OUTLIER` shows another thing, and so does one that is
darker and from which nothing is hidden.  A patch counts as

    1/(1 + (s² + d²)/EVEN²)                                                                                        (1)

of `WEIGHT` pixels, s the spread, and d the RMS difference between r and that of the neighbours: the outlines of shadows
lie beside those of a mesh that is not exact.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from factorlib.geometry.camera import Camera
from factorlib.geometry.ground import Plane
from factorlib.geometry.occlusion import LIFT, Occluders, SurfacePoints
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.distance import back_project, centre_and_size
from factorlib.robust import robust_deviation
from factorlib.urm.extract import Channels, observed_pixels
from factorlib.urm.observations import Observations

GROUND = "ground"  # name of the material of these observations
RADIUS = 1.0  # farthest point from the middle of the objects' feet, in their extent
PATCHES = 20  # patches across
LEAST_PIXELS = 4  # of a patch
CAST = 6  # pixels of a patch whose visibility is computed
LEAST_PATCHES = 60  # of a photo
NEIGHBOURS = 1.6  # farthest neighbour of a patch, in patches: those at its corners
RIM = 3  # width of the border of an object, pixels: its colour is mixed with the ground's
MOST_DEGREE = 2
EVEN = 0.03  # spread of an even ground, as of log radiance
LEAST_SPREAD = 1e-3  # keeps weights finite on a ground without any pattern
MOST_SPREAD = 0.08  # spread of a ground that is not used
WEIGHT = 2.0  # pixels that a patch counts as: errors of neighbouring pixels are alike
OUTLIER = 0.3
ITERATIONS = 30  # of the robust fit
LEAST_RADIANCE = 1e-6


class GroundView(NamedTuple):
    """Objects on their ground before a camera.

    Attributes:
        camera: Camera.
        ground: Plane on which the objects stand, in the camera's frame.
        objects: The objects.
    """

    camera: Camera
    ground: Plane
    objects: Occluders

    def on_plane(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return coordinates on the plane, about the middle of the objects' feet, in units of the objects' extent."""
        vertices = self.objects.mesh.vertices
        feet = self.ground.onto(vertices)
        normal = self.ground.normal
        first = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
        axes = np.stack([first, np.cross(normal, first)], axis=1) / np.linalg.norm(first)
        extent = np.linalg.norm(np.ptp(vertices, axis=0))
        return (points - (feet.min(0) + feet.max(0)) / 2) @ axes / extent

    def visibility(self, points: Float[np.ndarray, "n 3"], directions: int) -> UInt8[np.ndarray, "n k"]:
        """Return the visibility of directions, 0 or 255, from points of the ground past the objects."""
        normal = np.tile(self.ground.normal, (len(points), 1))
        lifted = points + LIFT * self.objects.radius * normal
        places = SurfacePoints(lifted, normal, np.ones(len(points), bool))
        return self.objects.visibility_from(places, normal, fibonacci_sphere(directions)).visibility


class Patches(NamedTuple):
    """Patches of the ground, m of them.

    Attributes:
        pixel: Mean column and row.
        point: Mean point, in the camera's frame.
        log_radiance: Logarithm of the median radiance.
        visibility: Mean visibility of k directions, 0 to 255.
    """

    pixel: Float[np.ndarray, "m 2"]
    point: Float[np.ndarray, "m 3"]
    log_radiance: Float[np.ndarray, "m 3"]
    visibility: UInt8[np.ndarray, "m k"]


def ground_observations(
    photo: Channels, geometry: Channels, view: GroundView, observed: Observations, directions: int
) -> Observations | None:
    """Return observations of the ground of one photo, of radiance relative to that without shadows; None if unfit.

    Args:
        photo: Channels of the stage `masks`.
        geometry: Channels of the stage `align`.
        view: Camera, ground and objects.
        observed: Observations of the objects.
        directions: Number of directions of visibility.
    """
    patches = _ground_patches(photo, view, directions)
    if patches is None:
        return None
    place = view.on_plane(patches.point)
    cosine = np.maximum(fibonacci_sphere(directions) @ view.ground.normal, 0)
    shade, spread = remove_trend(patches.log_radiance, place, patches.visibility @ cosine)
    mean = shade.mean(1)
    plain = (mean < OUTLIER) & ((patches.visibility.min(1) < 255) | (mean > -OUTLIER))
    if spread > MOST_SPREAD or plain.sum() < LEAST_PATCHES:
        return None
    near = cKDTree(place).query_ball_point(place, NEIGHBOURS * 2 * RADIUS / PATCHES)
    edge = np.array([np.square(mean[k] - mean[i]).mean() for i, k in enumerate(near)])  # d²
    weight = WEIGHT / (1 + (spread**2 + edge) / EVEN**2)  # (1)
    point = patches.point[plain]
    zero = np.zeros(len(point), "i4")
    return Observations(
        normal=np.tile(view.ground.normal, (len(point), 1)),
        view=-point / np.linalg.norm(point, axis=1, keepdims=True),
        radiance=np.exp(shade[plain]),
        clipped=np.zeros((len(point), 3), bool),
        material=zero.astype("i2"),
        photo=zero,
        illumination=zero,
        x=np.rint(patches.pixel[plain, 0]).astype("i4"),
        y=np.rint(patches.pixel[plain, 1]).astype("i4"),
        weight=weight[plain],
        materials=(GROUND,),
        photos=observed.photos,
        illuminations=observed.illuminations,
        visibility=patches.visibility[plain],
        place=_relative_to_objects(point, photo, geometry),
    )


def _ground_patches(photo: Channels, view: GroundView, directions: int) -> Patches | None:
    """Return the patches about the objects where `LEAST_PIXELS` show the ground; None if there are few."""
    radiance = np.stack([photo[c] for c in "RGB"], axis=-1)
    clipped = np.stack([photo[f"clipped.{c}"] for c in "RGB"], axis=-1).any(-1)
    hidden = binary_dilation((photo["label"] > 0) | (photo["left_out"] > 0), iterations=RIM)
    pixel = np.argwhere(~hidden & ~clipped & np.isfinite(radiance).all(-1))[:, ::-1]
    point = view.ground.hit(view.camera.rays_through(pixel + 0.5))
    place = view.on_plane(point) / RADIUS
    near = np.flatnonzero(np.linalg.norm(place, axis=1) < 1)  # not where a ray misses the ground
    # pixels by patch, in the order of pixels within one
    square = (np.floor((place[near] + 1) / 2 * PATCHES) @ [PATCHES, 1]).astype(int)
    order = near[np.argsort(square, kind="stable")]
    _, count = np.unique(square, return_counts=True)
    rows = [part for part in np.split(order, np.cumsum(count)[:-1]) if len(part) >= LEAST_PIXELS]
    if len(rows) < LEAST_PATCHES:
        return None
    x, y = pixel.T
    median = np.array([np.median(radiance[y[part], x[part]], axis=0) for part in rows])
    # visibility from CAST pixels of each patch, at even steps
    chosen = np.array([part[np.arange(CAST) * (len(part) - 1) // (CAST - 1)] for part in rows])
    visibility = view.visibility(point[chosen.reshape(-1)], directions).reshape(len(rows), CAST, -1)
    return Patches(
        np.array([pixel[part].mean(0) for part in rows]),
        np.array([point[part].mean(0) for part in rows]),
        np.log(np.maximum(median, LEAST_RADIANCE)).astype(float),
        np.rint(visibility.mean(1)).astype(np.uint8),
    )


def remove_trend(
    log_radiance: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "n 2"], light: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return log radiance less its polynomial, and the spread that is left over the less shadowed half.

    Args:
        log_radiance: r of each patch.
        place: x and y.
        light: Measure of the light that objects leave to each patch, such as that of an even sky.
    """
    lit = light >= np.median(light)
    x, y = place.T
    for degree in range(MOST_DEGREE + 1):
        terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
        weight = lit.astype(float)
        for _ in range(ITERATIONS):
            polynomial = np.linalg.lstsq(terms * weight[:, None], log_radiance * weight[:, None], rcond=None)[0]
            shade = log_radiance - terms @ polynomial
            spread = max(robust_deviation(shade.mean(1)[lit]), LEAST_SPREAD)
            weight = lit / np.sqrt(1 + (shade.mean(1) / spread) ** 2)
        if spread < EVEN:
            break
    return shade, spread


def _relative_to_objects(
    points: Float[np.ndarray, "n 3"], photo: Channels, geometry: Channels
) -> Float[np.ndarray, "n 3"]:
    """Return positions as those of the photo's other observations (`factorlib.light.distance`)."""
    pixels = observed_pixels(photo, geometry)
    view = np.stack([geometry[f"view.{axis}"][pixels] for axis in "xyz"], axis=-1)
    view /= np.maximum(np.linalg.norm(view, axis=-1, keepdims=True), 1e-12)
    seen = back_project(view, geometry["depth"][pixels].astype(float))
    centre, size = centre_and_size(seen, geometry["confidence"][pixels])
    return (points - centre) / size
