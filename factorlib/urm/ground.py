"""Observations of the ground about the objects of a photo: their shadows tell where its light comes from.

The light on a point of the ground is that of the directions which the objects do not hide from it (Sato, Sato and
Ikeuchi, "Illumination from shadows", 2003).  The ground is divided into square patches.  A patch has the median
radiance of its pixels, and the mean visibility of some of them, so that shares are as soft as shadows are.

Grounds have patterns, things stand on them, and near lamps make one side brighter.  Let r be the log radiance of a
patch.  A polynomial of its place is fitted to the less shadowed half of the patches, robustly, and taken away: the rest
is the log of the radiance relative to that without shadows.  The degree is the least, at most `MOST_DEGREE`, that
leaves a spread of `EVEN`.  A patch that is brighter by more than `OUTLIER` shows another thing, and so does one that is
darker and from which nothing is hidden.  A patch counts as

    1/(1 + (s² + d²)/EVEN²)                                                                                        (1)

of `WEIGHT` pixels, s the spread, and d the RMS difference between r and that of the neighbours: the outlines of shadows
lie beside those of a mesh that is not exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
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
RIM = 3  # width of the border of an object, pixels: its colour is mixed with the ground's
MOST_DEGREE = 2
EVEN = 0.03
MOST_SPREAD = 0.08  # spread of a ground that is not used
WEIGHT = 2.0  # pixels that a patch counts as: errors of neighbouring pixels are alike
OUTLIER = 0.3
ITERATIONS = 30  # of the robust fit
LEAST_RADIANCE = 1e-6


class GroundPixels(NamedTuple):
    """Pixels that show the ground.

    Attributes:
        pixel: Columns and rows.
        point: Points of the ground, in the camera's frame.
        patch: Number of each pixel's patch, from 0.
        radiance: Radiance.
    """

    pixel: Int[np.ndarray, "n 2"]
    point: Float[np.ndarray, "n 3"]
    patch: Int[np.ndarray, " n"]
    radiance: Float[np.ndarray, "n 3"]

    def take(self, rows: np.ndarray) -> GroundPixels:
        """Return the pixels `rows` alone."""
        return GroundPixels(*(values[rows] for values in self))

    def patch_means(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of values at the pixels over each patch."""
        sums = np.stack([np.bincount(self.patch, column) for column in values.T], axis=1)
        return sums / np.bincount(self.patch)[:, None]


def ground_observations(
    photo: Channels,
    geometry: Channels,
    camera: Camera,
    ground: Plane,
    occluders: Occluders,
    observed: Observations,
    directions: int,
) -> Observations | None:
    """Return observations of the ground of one photo, of radiance relative to that without shadows; None if unfit.

    Args:
        photo: Channels of the stage `masks`.
        geometry: Channels of the stage `align`.
        camera: Camera of the photo.
        ground: Plane on which the objects stand, in the camera's frame.
        occluders: The objects.
        observed: Observations of the objects.
        directions: Number of directions of visibility.
    """
    pixels = _ground_pixels(photo, camera, ground, occluders)
    if pixels is None:
        return None
    visibility = _visibility(pixels, ground, occluders, directions)
    cosine = np.maximum(fibonacci_sphere(directions) @ ground.normal, 0)
    point = pixels.patch_means(pixels.point)
    radiance = np.array([np.median(pixels.radiance[pixels.patch == k], axis=0) for k in range(len(point))])
    log_radiance = np.log(np.maximum(radiance, LEAST_RADIANCE))
    place = _on_plane(point, ground, occluders)
    shade, spread = remove_trend(log_radiance, place, visibility @ cosine)
    shadowed = visibility.min(1) < 255
    plain = (shade.mean(1) < OUTLIER) & (shadowed | (shade.mean(1) > -OUTLIER))
    if spread > MOST_SPREAD or plain.sum() < LEAST_PATCHES:
        return None
    near = cKDTree(place).query_ball_point(place, 1.6 * 2 * RADIUS / PATCHES)
    edge = np.array([np.square(shade[k].mean(1) - shade[i].mean()).mean() for i, k in enumerate(near)])
    weight = WEIGHT / (1 + (spread**2 + edge) / EVEN**2)  # (1)
    n = int(plain.sum())
    zero = np.zeros(n, "i4")
    pixel = np.rint(pixels.patch_means(pixels.pixel)[plain]).astype("i4")
    return Observations(
        normal=np.tile(ground.normal, (n, 1)),
        view=-point[plain] / np.linalg.norm(point[plain], axis=1, keepdims=True),
        radiance=np.exp(shade[plain]),
        clipped=np.zeros((n, 3), bool),
        material=np.zeros(n, "i2"),
        photo=zero,
        illumination=zero,
        x=pixel[:, 0],
        y=pixel[:, 1],
        weight=weight[plain],
        materials=(GROUND,),
        photos=observed.photos,
        illuminations=observed.illuminations,
        visibility=visibility[plain],
        place=_relative_to_objects(point[plain], photo, geometry),
    )


def _ground_pixels(photo: Channels, camera: Camera, ground: Plane, occluders: Occluders) -> GroundPixels | None:
    """Return the pixels about the objects that show the ground, in patches of `LEAST_PIXELS`; None if there are few."""
    radiance = np.stack([photo[c] for c in "RGB"], axis=-1)
    clipped = np.stack([photo[f"clipped.{c}"] for c in "RGB"], axis=-1).any(-1)
    hidden = binary_dilation((photo["label"] > 0) | (photo["left_out"] > 0), iterations=RIM)
    y, x = np.nonzero(~hidden & ~clipped & np.isfinite(radiance).all(-1))
    point = ground.hit(camera.rays_through(np.column_stack([x, y]) + 0.5))
    place = np.floor((_on_plane(point, ground, occluders) + RADIUS) / (2 * RADIUS) * PATCHES)
    near = np.linalg.norm(_on_plane(point, ground, occluders), axis=1) < RADIUS  # False where a ray misses the ground
    square = (place[near] @ [PATCHES, 1]).astype(int)
    names, patch, count = np.unique(square, return_inverse=True, return_counts=True)
    if (count >= LEAST_PIXELS).sum() < LEAST_PATCHES:
        return None
    number = np.cumsum(count >= LEAST_PIXELS) - 1
    whole = (count >= LEAST_PIXELS)[patch]
    rows = np.flatnonzero(near)[whole]
    return GroundPixels(
        np.column_stack([x, y])[rows], point[rows], number[patch[whole]], radiance[y[rows], x[rows]].astype(float)
    )


def _on_plane(points: Float[np.ndarray, "n 3"], ground: Plane, occluders: Occluders) -> Float[np.ndarray, "n 2"]:
    """Return coordinates on the plane, about the middle of the objects' feet, in units of the objects' extent."""
    vertices = occluders.mesh.vertices
    feet = ground.onto(vertices)
    first = np.cross(ground.normal, [0.0, 0.0, 1.0] if abs(ground.normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    axes = np.stack([first / np.linalg.norm(first), np.cross(ground.normal, first / np.linalg.norm(first))], axis=1)
    extent = np.linalg.norm(np.ptp(vertices, axis=0))
    return (points - (feet.min(0) + feet.max(0)) / 2) @ axes / extent


def _visibility(pixels: GroundPixels, ground: Plane, occluders: Occluders, directions: int) -> UInt8[np.ndarray, "m k"]:
    """Return the mean visibility of each patch, 0 to 255, over `CAST` of its pixels at even steps in their order."""
    order = np.argsort(pixels.patch, kind="stable")
    count = np.bincount(pixels.patch)
    steps = np.arange(CAST) * (count[:, None] - 1) // (CAST - 1)
    chosen = pixels.point[order[(np.cumsum(count) - count)[:, None] + steps].reshape(-1)]
    normal = np.tile(ground.normal, (len(chosen), 1))
    points = SurfacePoints(chosen + LIFT * occluders.radius * normal, normal, np.ones(len(chosen), bool))
    cast = occluders.visibility_from(points, normal, fibonacci_sphere(directions))
    return np.rint(cast.visibility.reshape(len(count), CAST, -1).mean(1)).astype(np.uint8)


def remove_trend(
    log_radiance: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "n 2"], light: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return log radiance less its polynomial, and the spread that is left over the less shadowed half.

    Args:
        log_radiance: r of each patch.
        place: x and y.
        light: Measure of the light that objects leave; that of the sky, for instance.
    """
    lit: Bool[np.ndarray, " n"] = light >= np.median(light)
    x, y = place.T
    for degree in range(MOST_DEGREE + 1):
        terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
        weight = lit.astype(float)
        for _ in range(ITERATIONS):
            polynomial = np.linalg.lstsq(terms * weight[:, None], log_radiance * weight[:, None], rcond=None)[0]
            shade = log_radiance - terms @ polynomial
            spread = max(robust_deviation(shade.mean(1)[lit]), 1e-3)
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
