"""Radiance that arrives at the objects of a photo from their surroundings, where the photo shows these.

A pixel that shows no object shows a point p of the surroundings.  From the objects' centre c, light of about the same
radiance arrives along p − c.  Above the horizon of the ground, p is taken as infinitely far away.  On the ground, a
plane through f with normal n below the objects, the pixel's ray d meets

    p = d (f · n)/(d · n).                                                                                           (1)

So a photo that looks down on an object shows most of the light that reaches it from below.  Photos are not proofs: a
backdrop may hide the lamps, and a cut-out has no surroundings at all.  A solve therefore leaves out a
background that the observations of the objects contradict (`factorlib.inference.choices.model_selection`).
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_of_direction
from factorlib.geometry.camera import Camera
from factorlib.geometry.ground import Plane

ROWS = 48  # rows of the map; a texel is 3.75° high
RIM = 2  # width of the border of an object, pixels: its colour is mixed with the background's
LEAST_PIXELS = 3  # least number of pixels that a texel is averaged over
MOST_CLIPPED = 0.2  # largest share of clipped ones among them: a clipped pixel is a lower bound


def surrounding_radiance(
    photo: Mapping[str, Float[np.ndarray, "h w"]],
    camera: Camera,
    centre: Float[np.ndarray, "3"],
    ground: Plane | None,
) -> Float[np.ndarray, "48 96 3"]:
    """Return a lat-long map of the surroundings in the camera's y-up frame, in the photo's radiance; 0 where unseen.

    Args:
        photo: Channels R, G, B, label, left_out and clipped.R/G/B of the stage `masks`.
        camera: Camera of the photo.
        centre: c, centre of the visible points of the objects, in the camera's frame.
        ground: Plane below the objects, in the camera's frame; None if unknown.
    """
    hidden = (photo["label"] > 0) | (photo["left_out"] > 0)
    radiance = np.stack([photo[c] for c in "RGB"], axis=-1)
    visible = ~binary_dilation(hidden, iterations=RIM) & np.isfinite(radiance).all(-1)
    rays = camera.rays()[visible]
    direction = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    if ground is not None:  # (1)
        towards = ground.hit(rays) - centre
        on_ground = np.isfinite(towards).all(1)
        direction[on_ground] = (towards / np.linalg.norm(towards, axis=1, keepdims=True))[on_ground]
    # mean radiance of the pixels of each texel
    row, column = lat_long_of_direction(direction @ YUP_FROM_CAMERA.T)
    row, column = (np.floor(t * n).astype(int).clip(0, n - 1) for t, n in ((row, ROWS), (column, 2 * ROWS)))
    texel = row * 2 * ROWS + column
    size = 2 * ROWS**2
    clipped = np.stack([photo[f"clipped.{c}"][visible] for c in "RGB"], axis=1).any(1)
    pixels, clipped_pixels = np.bincount(texel, minlength=size), np.bincount(texel, clipped, size)
    sums = np.stack([np.bincount(texel, values, size) for values in radiance[visible].T], axis=1)
    means = sums / np.maximum(pixels, 1)[:, None]
    means[(pixels < LEAST_PIXELS) | (clipped_pixels > MOST_CLIPPED * pixels) | (means <= 0).any(1)] = 0
    return means.reshape(ROWS, 2 * ROWS, 3)
