"""Silhouettes of objects in a photo, from its masks, with the pixels that remain unknown."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

UNKNOWN = -1
Channels = Mapping[str, Float[np.ndarray, "h w"]]  # channels that the stage `masks` writes
Labels = Int[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]


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
