"""A picture to judge a pose by: the photo dimmed, the mesh tinted by its normals, its contours drawn."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_dilation

from factorlib.align.silhouette import Silhouette
from factorlib.geometry.raster import Maps
from factorlib.images.picture import picture as sdr_picture

MESH, MASK = np.array([1.0, 0.15, 0.75]), np.array([0.2, 1.0, 0.2])  # contour colours


def overlay(radiance: Float[np.ndarray, "h w 3"], maps: Maps, silhouette: Silhouette) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB picture; magenta: contour of the mesh and of its parts, green: of the mask; grey-blue: left out."""
    picture = 0.55 / 255 * sdr_picture(radiance).astype(float)
    mesh, unknown = maps.label > 0, ~silhouette.known
    tint = (maps.normal * (1, -1, -1) + 1) / 2  # the usual colours: x red right, y green up, z blue to the viewer
    picture[mesh] = 0.6 * picture[mesh] + 0.4 * tint[mesh]
    picture[unknown] = 0.7 * picture[unknown] + 0.3 * np.array([0.4, 0.5, 0.7])
    width = max(1, round(max(mesh.shape) / 600))
    for label, colour in ((np.maximum(silhouette.label, 0), MASK), (maps.label + 1000 * maps.object, MESH)):
        contour = np.zeros(label.shape, bool)  # whose label differs from the one right of or below them
        contour[:, :-1] |= label[:, :-1] != label[:, 1:]
        contour[:-1] |= label[:-1] != label[1:]
        picture[binary_dilation(contour, iterations=width) if width > 1 else contour] = colour
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
