"""Confidence in the normal of each pixel, from 0 to 1, and an overlay picture for judging a pose by eye.

A coarse mesh does not tell how its surface bends within a face, nor a thin part how it bends within a pixel. The
variance of the normal then grows by the factor

    1 + (facet / FACET)² + (turn / TURN)²,                                                                       (1)

facet: largest angle between the face's normal and its corners' normals
turn:  RMS angle of the normals of 3 × 3 pixels about their mean

Confidence is the inverse of (1), times factors for contours, depth jumps, slant and sides.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_dilation, distance_transform_edt, uniform_filter

from factorlib.align.silhouette import Silhouette
from factorlib.geometry.raster import Maps
from factorlib.images.picture import picture as sdr_picture

FULL_DISTANCE = 0.01  # share of the mask's extent: nearer to a contour, a small error of pose shows another place
FULL_COSINE = 0.3  # at a smaller cosine, a small error of shape turns the normal much
INSIDE_OF_SHELL = 0.3  # factor on back faces: the inside of an open shell is often another surface than the outside
DEPTH_JUMP = 0.02  # share of the object's depth range: a larger step to the next pixel is a depth jump
STEEPER = 3.0  # and the step must be this many times its neighbours, so that slanted surfaces do not count

# On data/eames, whose true normals are known, the median error of normals is 1.1° where facet is less than 5°, 2.3°
# from 10° to 16° and 8° beyond; it is 20° on flat faces where turn is more than 20°. An angle of 12° gave better
# lights than 5°.
FACET = np.radians(12.0)
TURN = np.radians(20.0)
MESH = np.array([1.0, 0.15, 0.75])  # contour colour of the mesh, magenta
MASK = np.array([0.2, 1.0, 0.2])  # contour colour of the mask, green


def confidence(maps: Maps, silhouette: Silhouette) -> Float[np.ndarray, "h w"]:
    """Return the confidence in each pixel's normal.

    It is the product of five factors: distance to contours, to depth jumps and to pixels where mask and mesh disagree;
    slant; visible side; the inverse of (1). It is 0 where mask and mesh have different materials, where there is no
    mesh, and where the normal was bent.
    """
    agree = (maps.label > 0) & (silhouette.label == maps.label) & ~_depth_jumps(maps)
    if not agree.any():
        return np.zeros(agree.shape)
    # distance to contours, jumps and disagreement; slant
    extent = max(np.ptp(where) for where in np.nonzero(agree)) + 1
    distance = distance_transform_edt(np.pad(agree, 1, mode="edge"))[1:-1, 1:-1]
    result = np.clip(distance / max(FULL_DISTANCE * extent, 1.0), 0, 1) * np.clip(maps.edge / FULL_COSINE, 0, 1)
    unsure = (maps.facet / FACET) ** 2 + (normal_spread(maps) / TURN) ** 2  # (1) less 1
    return result * np.where(maps.back, INSIDE_OF_SHELL, 1.0) * ~maps.bent / (1 + unsure)


def normal_spread(maps: Maps) -> Float[np.ndarray, "h w"]:
    """Return turn of (1) in radians: the spread of the normals of the 3 × 3 pixels that show a mesh."""
    mesh = (maps.label > 0).astype(float)
    share = np.maximum(uniform_filter(mesh, 3, mode="constant"), 1e-12)
    sums = [uniform_filter(n, 3, mode="constant") for n in np.moveaxis(maps.normal, -1, 0)]
    # |mean| = 1 − turn²/2 for small angles
    mean = np.stack(sums, axis=-1) / share[..., None]
    return np.sqrt(np.maximum(2 - 2 * np.linalg.norm(mean, axis=-1), 0)) * mesh


def _depth_jumps(maps: Maps) -> Bool[np.ndarray, "h w"]:
    """Return the pixels on both sides of an abrupt change of depth, or of object, to the right or lower neighbour."""
    mesh = maps.label > 0
    result = np.zeros(mesh.shape, bool)
    limit = DEPTH_JUMP * max(float(np.ptp(maps.depth[mesh])), 1e-12) if mesh.any() else np.inf
    for axis in (0, 1):
        first = (slice(None),) * axis + (slice(None, -1),)
        second = (slice(None),) * axis + (slice(1, None),)
        # steps of depth larger than the limit and much larger than the neighbouring steps
        both = mesh[first] & mesh[second]
        step = np.where(both, np.abs(maps.depth[first] - maps.depth[second]), np.inf)
        padded = np.pad(step, [(1, 1) if k == axis else (0, 0) for k in range(2)], constant_values=np.inf)
        before, after = (np.take(padded, range(k, k + step.shape[axis]), axis) for k in (0, 2))
        steep = step > STEEPER * np.minimum(before, after)
        jump = both & (((step > limit) & steep) | (maps.object[first] != maps.object[second]))
        result[first] |= jump
        result[second] |= jump
    return result


def overlay(radiance: Float[np.ndarray, "h w 3"], maps: Maps, silhouette: Silhouette) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the aligned mesh over the photo as an sRGB picture.

    Contours of the mesh and of its parts are magenta, those of the mask are green; pixels left out are grey-blue.

    Args:
        radiance: The photo, linear.
        maps: Rendered maps of the mesh.
        silhouette: The mask.

    Returns:
        The picture.
    """
    picture = 0.55 / 255 * sdr_picture(radiance).astype(float)
    mesh = maps.label > 0
    unknown = ~silhouette.known
    # the usual colours of normals: red to the right, green upward, blue toward the viewer
    picture[mesh] = 0.6 * picture[mesh] + 0.4 * ((maps.normal * (1, -1, -1) + 1) / 2)[mesh]
    picture[unknown] = 0.7 * picture[unknown] + 0.3 * np.array([0.4, 0.5, 0.7])
    width = max(1, round(max(mesh.shape) / 600))
    for label, colour in ((np.maximum(silhouette.label, 0), MASK), (maps.label + 1000 * maps.object, MESH)):
        # pixels whose label differs from that of the right or lower neighbour
        contour = np.zeros(label.shape, bool)
        contour[:, :-1] |= label[:, :-1] != label[:, 1:]
        contour[:-1] |= label[:-1] != label[1:]
        picture[binary_dilation(contour, iterations=width) if width > 1 else contour] = colour
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
