"""Mattes: how probably each pixel of a photo shows the foreground.

A photo's own alpha channel is its matte.  Else a network estimates it: U²-Net small (Qin et al. 2020), a file of the
extra `masks`, or any ONNX model of the form that rembg uses.  Its input is one RGB picture, its first output the
foreground.  onnxruntime evaluates it on the CPU.  Nothing is downloaded.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

from factorlib.errors import InputError
from factorlib.images.photo import read_alpha
from factorlib.labels.mask_files import opaque_part
from factorlib.reading import reading

MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of ImageNet's colours, by which models are trained
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
SIDE = 320  # side of the input of a model that does not state it, pixels
LEAST_PIECE = 0.05  # least area of a piece of the foreground, as a share of the largest one's
# Width of the uncertain border of a matte of SIDE pixels from which it is drawn over.  Mattes of 0.98 IoU and more have
# 1.7 to 3.1 pixels, worse ones mostly 3.5 and more (docs/photos.md).
MOST_DOUBT = 3.5

Matte = Float[np.ndarray, "h w"]


def opaque_pixels(path: Path) -> Bool[np.ndarray, "h w"] | None:
    """Return the opaque pixels of a photo as displayed; None if it has no alpha channel, or one that hides nothing."""
    alpha = read_alpha(path)
    return None if alpha is None else opaque_part(alpha)


def foreground(matte: Matte) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the foreground, without its small pieces."""
    inside = matte > 0.5
    pieces, _ = ndimage.label(inside)
    areas = np.bincount(pieces[inside], minlength=1)
    return inside & (areas >= LEAST_PIECE * areas.max())[pieces]


def doubt(matte: Matte) -> float:
    """Return the entropy of a matte by the length of its contour: the width of the uncertain border, pixels."""
    p = matte.clip(1e-6, 1 - 1e-6)
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    inside = matte > 0.5
    return float(entropy.sum() / max(np.count_nonzero(inside & ~ndimage.binary_erosion(inside)), 1))


class MatteModel:
    """A network that estimates mattes, read from an ONNX file; by default the one of the extra `masks`.

    Raises:
        InputError: onnxruntime or the model is missing, or the file is not an ONNX model.
    """

    def __init__(self, path: Path | None = None):
        package = find_spec("rembg")  # the package of the extra `masks`
        if find_spec("onnxruntime") is None or (path is None and (package is None or package.origin is None)):
            raise InputError(
                "automatic masks need a network, which is not installed",
                key="MATTE",
                cure="make setup EXTRAS=masks, or name a model with MATTE=<file.onnx>; "
                "or use photos with an alpha channel",
            )
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        path = path or Path(str(package.origin)).with_name("u2netp.onnx")  # type: ignore[union-attr]
        with reading("an ONNX model", path, "MATTE", "give a model of rembg's form", also=(Exception,)):
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
            self.input = self.session.get_inputs()[0]

    def __call__(self, pixels: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> tuple[Matte, float]:
        """Return the matte of a photo.

        Args:
            pixels: the photo, sRGB-encoded
            size: height and width of the matte

        Returns:
            The matte, and its doubt in pixels of a matte of SIDE pixels.
        """
        height, width = (side if isinstance(side, int) else SIDE for side in self.input.shape[2:])
        small = np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.LANCZOS), np.float32)
        small = (small / max(small.max(), 1) - MEAN) / DEVIATION
        matte = self.session.run(None, {self.input.name: small.transpose(2, 0, 1)[None]})[0].reshape(height, width)
        if matte.min() < 0 or matte.max() > 1:  # Some models end before their sigmoid.
            matte = 1 / (1 + np.exp(-matte))
        whole = Image.fromarray(matte).resize(size[::-1], Image.Resampling.BILINEAR)
        return np.asarray(whole), doubt(matte) * SIDE / height
