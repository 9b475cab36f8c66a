"""What the masks of a photo say about where its objects are, and what they leave open."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

UNKNOWN = -1
Channels = Mapping[str, Float[np.ndarray, "h w"]]  # of the stage `masks`
Labels = Int[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]


class Silhouette(msgspec.Struct, frozen=True):
    """Which pixels of a photo show an object (or all of them together), by material.

    label  [h, w] int16: material k, 0 background, UNKNOWN where the photo does not say: left out by the user,
           or covered by something that may stand in front of the object
    """

    label: Labels

    @property
    def inside(self) -> Mask:
        """Where the photo shows some material of the object."""
        return self.label > 0

    @property
    def known(self) -> Mask:
        """Where the photo says what is seen."""
        return self.label != UNKNOWN


def silhouette_of_photo(channels: Channels) -> Silhouette:
    """Return the silhouette of the whole photo, from the channels that the masks stage wrote."""
    label = np.round(channels["label"]).astype(np.int16)
    if "left_out" in channels:
        label[channels["left_out"] > 0.5] = UNKNOWN
    return Silhouette(label)


def silhouette_of_object(channels: Channels, number: int, labels: Sequence[int], own_mask: bool) -> Silhouette:
    """Return the silhouette of object `number` (from 1), whose mesh carries `labels`.

    With a mask of its own, what lies in it is the object; without, every pixel of its materials that no other object
    claims.  Pixels of other objects and of foreign materials may hide it: UNKNOWN.
    """
    label = silhouette_of_photo(channels).label
    owner = np.round(channels["object"]).astype(int) if "object" in channels else np.zeros(label.shape, int)
    mine = owner == number if own_mask else np.isin(label, labels) & ((owner == 0) | (owner == number))
    label[~mine & ((label > 0) | ((owner > 0) & (owner != number)))] = UNKNOWN
    return Silhouette(label)


def silhouette_iou(silhouette: Silhouette, mesh_label: Labels) -> float:
    """Intersection over union of mask and mesh over the pixels that are known; 0 where there is neither.

    >>> silhouette_iou(Silhouette(np.array([[0, 1, 1, UNKNOWN]])), np.array([[1, 1, 0, 1]]))
    0.3333333333333333
    """
    mesh = (mesh_label > 0) & silhouette.known
    return _share(silhouette.inside & mesh, silhouette.inside | mesh)


def label_agreement(silhouette: Silhouette, mesh_label: Labels) -> float:
    """Share of the pixels in both mask and mesh whose material is the same in both; 0 where there are none.

    >>> label_agreement(Silhouette(np.array([[0, 1, 2]])), np.array([[1, 1, 1]]))
    0.5
    """
    both = silhouette.inside & (mesh_label > 0)
    return _share(both & (silhouette.label == mesh_label), both)


def labelled_iou(silhouette: Silhouette, mesh_label: Labels) -> float:
    """IoU that counts a pixel as shared only if its material is the same too: what the search maximises.

    >>> labelled_iou(Silhouette(np.array([[0, 1, 2, 1]])), np.array([[1, 1, 1, 1]]))
    0.5
    """
    union = silhouette.known & (silhouette.inside | (mesh_label > 0))
    return _share(silhouette.inside & (silhouette.label == mesh_label), union)


def _share(part: Mask, whole: Mask) -> float:
    total = np.count_nonzero(whole)
    return float(np.count_nonzero(part) / total) if total else 0.0
