"""Mask of an object in a photo, with the photo's camera and the prior of its focal length."""

import msgspec
import numpy as np

from factorlib.align.silhouette import Silhouette
from factorlib.geometry.camera import Camera

TYPICAL_FOCAL = 1.5  # most probable focal length, in units of the photo's longer side; wide angle 0.7, portrait 2.5
TYPICAL_SIGMA = 0.5  # its standard deviation, log
EXIF_SIGMA = 0.05  # log: EXIF rounds to whole millimetres and ignores focus


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
