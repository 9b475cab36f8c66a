"""Silhouettes of objects in a photo, from its masks, with the photo's camera and the prior of its focal length.

Pixels of which the photo does not tell what they show are UNKNOWN.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

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
    """Return the silhouette of the whole photo, from the channels that the stage `masks` wrote."""
    label = np.round(channels["label"]).astype(np.int16)
    if "left_out" in channels:
        label[channels["left_out"] > 0.5] = UNKNOWN
    return Silhouette(label)


def silhouette_of_object(channels: Channels, number: int, labels: Sequence[int], own_mask: bool) -> Silhouette:
    """Return the silhouette of one object.

    Pixels of other objects and of foreign materials may hide it: they are UNKNOWN.

    Args:
        channels: Channels that the stage `masks` wrote.
        number: Number of the object in the photo, from 1.
        labels: Labels that the object's mesh carries.
        own_mask: Whether the object has a mask of its own. If so, it is what lies in that mask; if not, it is every
            pixel of its materials that no other object claims.

    Returns:
        The silhouette.
    """
    label = silhouette_of_photo(channels).label
    owner = np.round(channels["object"]).astype(int) if "object" in channels else np.zeros(label.shape, int)
    mine = owner == number if own_mask else np.isin(label, labels) & ((owner == 0) | (owner == number))
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
    both = silhouette.inside & (mesh_label > 0)
    return _share(both & (silhouette.label == mesh_label), both)


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
        """Number of unknowns of `PoseState.moved` that may move; the last one is the focal length."""
        return 7 if self.focal_sigma > 0 else 6

    def mirrored(self) -> "ObjectView":
        """Return the view with left and right exchanged."""
        camera = msgspec.structs.replace(
            self.camera, centre=(self.camera.width - self.camera.centre[0], self.camera.centre[1])
        )
        silhouette = Silhouette(np.ascontiguousarray(self.silhouette.label[:, ::-1]))
        return ObjectView(silhouette, camera, self.focal_sigma)


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
