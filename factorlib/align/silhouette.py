"""Silhouettes of objects in a photo, from its masks, with the photo's camera and the prior of its focal length.

Pixels of which the photo does not tell what they show are UNKNOWN. A `Target` is a silhouette at a resolution at which
poses are compared with it quickly. For each material, the signed distance to the border of its region tells how far,
and in which direction, a contour of the mesh is off. Unknown pixels are a dead zone: a contour may lie there at no
cost. So an occluder or the frame of the photo is never taken for the object's own contour.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from factorlib.geometry.camera import Camera

UNKNOWN = -1
Channels = Mapping[str, Float[np.ndarray, "h w"]]  # channels that the stage `masks` writes
Labels = Int[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
TYPICAL_FOCAL = 1.5  # most probable focal length, in units of the photo's longer side; wide angle 0.7, portrait 2.5
TYPICAL_SIGMA = 0.5  # its standard deviation, log
EXIF_SIGMA = 0.05  # log: EXIF rounds to whole millimetres and ignores focus


class Silhouette(msgspec.Struct, frozen=True):
    """Label image of one object, or of all objects of a photo together.

    label  [h, w] int16: material k, 0 background, UNKNOWN where the photo does not tell: left out by the user,
           or covered by something that may be in front of the object
    """

    label: Labels

    @property
    def inside(self) -> Mask:
        """Mask of the pixels that show some material of the object."""
        return self.label > 0

    @property
    def known(self) -> Mask:
        """Mask of the pixels that are not UNKNOWN."""
        return self.label != UNKNOWN


def silhouette_of_photo(channels: Channels) -> Silhouette:
    """Return the silhouette of all objects of a photo together, from the channels that the stage `masks` wrote."""
    label = np.round(channels["label"]).astype(np.int16)
    if "left_out" in channels:
        label[channels["left_out"] > 0.5] = UNKNOWN
    return Silhouette(label)


def silhouette_of_object(channels: Channels, number: int, labels: Sequence[int], has_mask: bool) -> Silhouette:
    """Return the silhouette of one object.

    Pixels of other objects and of foreign materials may hide it: they are UNKNOWN.

    Args:
        channels: Channels that the stage `masks` wrote.
        number: Number of the object in the photo, from 1.
        labels: Labels that the object's mesh carries.
        has_mask: Whether the object has a mask of its own. If so, it is what lies in that mask; if not, it is every
            pixel of its materials that no other object claims.

    Returns:
        The silhouette.
    """
    label = silhouette_of_photo(channels).label
    owner = np.round(channels["object"]).astype(int) if "object" in channels else np.zeros(label.shape, int)
    mine = owner == number if has_mask else np.isin(label, labels) & ((owner == 0) | (owner == number))
    label[~mine & ((label > 0) | ((owner > 0) & (owner != number)))] = UNKNOWN
    return Silhouette(label)


def silhouette_iou(silhouette: Silhouette, mesh_label: Labels) -> float:
    """Return the intersection over union of mask and mesh over the known pixels; 0 if both are empty.

    >>> silhouette_iou(Silhouette(np.array([[0, 1, 1, UNKNOWN]])), np.array([[1, 1, 0, 1]]))
    0.3333333333333333
    """
    mesh = (mesh_label > 0) & silhouette.known
    return _share(silhouette.inside & mesh, silhouette.inside | mesh)


def label_agreement(silhouette: Silhouette, mesh_label: Labels) -> float:
    """Return the share of pixels in both mask and mesh whose materials agree; 0 if there are none.

    >>> label_agreement(Silhouette(np.array([[0, 1, 2]])), np.array([[1, 1, 1]]))
    0.5
    """
    overlap = silhouette.inside & (mesh_label > 0)
    return _share(overlap & (silhouette.label == mesh_label), overlap)


def labelled_iou(silhouette: Silhouette, mesh_label: Labels) -> float:
    """Return the IoU that counts a pixel as shared only if its materials agree; the search maximises it.

    >>> labelled_iou(Silhouette(np.array([[0, 1, 2, 1]])), np.array([[1, 1, 1, 1]]))
    0.5
    """
    union = silhouette.known & (silhouette.inside | (mesh_label > 0))
    return _share(silhouette.inside & (silhouette.label == mesh_label), union)


def _share(part: Mask, whole: Mask) -> float:
    """Return the number of pixels in `part` over that in `whole`; 0 if `whole` is empty."""
    total = np.count_nonzero(whole)
    return float(np.count_nonzero(part) / total) if total else 0.0


class ObjectView(msgspec.Struct, frozen=True):
    """Mask of an object, the photo's camera, and the prior log f ~ Normal(log camera.focal, focal_sigma).

    A sigma of 0 means that the focal length is known.
    """

    silhouette: Silhouette
    camera: Camera
    focal_sigma: float = 0.0

    @property
    def free(self) -> int:
        """Number of free unknowns of `PoseState.apply_step`: 7, or 6 if the focal length is known."""
        return 7 if self.focal_sigma > 0 else 6


def with_prior_focal(camera: Camera, focal: float | None, source: str | None) -> tuple[Camera, float]:
    """Return the camera at its most probable focal length, and the prior's standard deviation of the logarithm.

    Args:
        camera: The photo's camera; its focal length is not used.
        focal: Focal length in pixels; None if it is unknown, for a broad prior.
        source: Source of the focal length; "exif" makes it uncertain, any other exact.

    Returns:
        The camera and the standard deviation, 0 for a known focal length.
    """
    if focal is None:
        typical = TYPICAL_FOCAL * max(camera.width, camera.height)
        return msgspec.structs.replace(camera, focal=typical), TYPICAL_SIGMA
    return msgspec.structs.replace(camera, focal=focal), EXIF_SIGMA if source == "exif" else 0.0


class Region(msgspec.Struct, frozen=True):
    """Region of one material in a `Target`, in pixels of its window.

    distance  [h, w] signed distance to the region's border, negative inside, 0 where unknown
    slope     [h, w, 2] its gradient (x, y)
    contour   [n, 2] points (x, y) between the region's pixels and known pixels outside it
    outward   [n, 2] unit directions out of the region there
    """

    distance: Float[np.ndarray, "h w"]
    slope: Float[np.ndarray, "h w 2"]
    contour: Float[np.ndarray, "n 2"]
    outward: Float[np.ndarray, "n 2"]


class Target(msgspec.Struct, frozen=True):
    """Part of the photo around an object's mask, resampled, to which poses are fitted.

    view         photo and camera of the object
    left, top    corner of the window in the photo, photo pixels
    pixel        photo pixels per window pixel
    silhouette   the mask in the window
    regions      region of each material of the mesh, by label
    """

    view: ObjectView
    left: float
    top: float
    pixel: float
    silhouette: Silhouette
    regions: dict[int, Region]

    def window(self, focal: float) -> Camera:
        """Return the photo's camera at a focal length, restricted to the window, in the window's pixels."""
        height, width = self.silhouette.label.shape
        camera = msgspec.structs.replace(self.view.camera, focal=focal)
        return camera.window(self.left, self.top, self.pixel, width, height)

    @property
    def extent(self) -> float:
        """Longer side of the mask's bounding box, window pixels."""
        return bounding_box(self.silhouette)[2]


def bounding_box(silhouette: Silhouette) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the lowest and highest (x, y) corner of the mask's bounding box, and its longer side, in pixels."""
    rows, columns = np.nonzero(silhouette.inside)
    low = np.array([columns.min(), rows.min()], float)
    high = np.array([columns.max(), rows.max()], float) + 1
    return low, high, float((high - low).max())


def make_target(view: ObjectView, labels: tuple[int, ...], resolution: int, margin: float = 0.2) -> Target:
    """Cut out the mask with a margin around it and compute the region of each material.

    Args:
        view: The mask of the object and the photo's camera.
        labels: Labels of the mesh's materials.
        resolution: Pixels of the mask's longer side in the window; fewer if the photo has fewer.
        margin: Margin as a share of the mask's extent.

    Returns:
        The window.
    """
    silhouette = view.silhouette
    low, high, extent = bounding_box(silhouette)
    pixel = max(extent / resolution, 1.0)
    height, width = silhouette.label.shape
    # nearest photo pixel of each window pixel
    low = np.maximum(np.floor(low - margin * extent), 0)
    high = np.minimum(np.ceil(high + margin * extent), (width, height))
    columns, rows = (np.arange(int(np.ceil((high[k] - low[k]) / pixel))) for k in (0, 1))
    x = np.minimum((low[0] + (columns + 0.5) * pixel).astype(int), width - 1)
    y = np.minimum((low[1] + (rows + 0.5) * pixel).astype(int), height - 1)
    window = silhouette.label[np.ix_(y, x)]
    # one pixel around the window, unknown beyond the photo's frame
    padded = np.pad(window, 1, mode="edge")
    borders = low[1] == 0, high[1] == height, low[0] == 0, high[0] == width
    for is_frame, edge in zip(borders, (padded[0], padded[-1], padded[:, 0], padded[:, -1]), strict=True):
        if is_frame:
            edge[:] = UNKNOWN
    regions = {label: _region(padded == label, padded != UNKNOWN) for label in labels}
    return Target(view, float(low[0]), float(low[1]), pixel, Silhouette(window), regions)


def _region(inside: Mask, known: Mask) -> Region:
    """Return the region `inside`, from a window with a border of one pixel around it."""

    def distance_to(mask: Mask) -> Float[np.ndarray, "h w"]:
        """Return the distance of each pixel to the nearest pixel in `mask`."""
        return distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, float(sum(mask.shape)))

    # signed distance to the border, 0 on unknown pixels, and its gradient
    distance = np.where(inside, 0.5 - distance_to(~inside), distance_to(inside | ~known) - 0.5)
    distance[~known] = 0.0
    by_y, by_x = np.gradient(distance)
    slope = np.stack([by_x, by_y], axis=-1)
    # contour points between neighbouring pixels, with their normals
    a, b = border_pairs(inside, known & ~inside)
    normal = slope[a[:, 0], a[:, 1]] + slope[b[:, 0], b[:, 1]]
    length = np.linalg.norm(normal, axis=1)
    clear = length > 0.4  # a vanishing gradient has no direction
    contour = ((a + b) / 2 + 0.5)[clear][:, ::-1]
    outward = normal[clear] / length[clear, None]
    return Region(distance[1:-1, 1:-1], slope[1:-1, 1:-1], contour - 1.0, outward)


def border_pairs(inside: Mask, outside: Mask) -> tuple[Int[np.ndarray, "n 2"], Int[np.ndarray, "n 2"]]:
    """Return pairs of neighbouring pixels (row, column): the first in `inside`, the second in `outside`.

    Neighbours are right, left, upper and lower ones.
    """
    pairs = []
    for axis in (0, 1):
        low = (slice(None),) * axis + (slice(None, -1),)
        high = (slice(None),) * axis + (slice(1, None),)
        step = np.eye(2, dtype=int)[axis]
        first = np.argwhere(inside[low] & outside[high])
        second = np.argwhere(outside[low] & inside[high])
        pairs += [(first, first + step), (second + step, second)]
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
