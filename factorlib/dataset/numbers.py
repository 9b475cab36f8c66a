"""Which numbers can be meant: finite ones, of a size that occurs, and rotations that are rotations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from factorlib.dataset.paths import Refusal

LARGEST = 1e15  # of any number: what is larger loses its digits in the squares that are taken of it
FOCAL_PX = 1.0, 1e7  # a telescope has 1e6
CENTRE_PX = 1e6  # a principal point from the photo's corner, even of a small crop
UNITS = 1e-9, 1e9  # of one length in another
SIDE_PX = 1e6  # width or height of an image
ROTATION_TOLERANCE = 1e-3  # largest entry of RᵀR − 1: matrices typed with four digits pass


def check_numbers(value: Any, refuse: Refusal) -> None:
    """Every number of a struct, or of plain data, is finite and none is beyond LARGEST."""
    for key, number in _numbers(msgspec.to_builtins(value), ""):
        if not math.isfinite(number):
            refuse(key, f"{number} is not a finite number", "give a number, or leave the key out")
        if abs(number) > LARGEST:
            fault = f"{number:.3g} is larger than anything that is measured here"
            refuse(key, fault, f"give less than {LARGEST:g}, in another unit if need be")


def _numbers(value: Any, key: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield key, value
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _numbers(item, f"{key}.{name}" if key else name)
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _numbers(item, f"{key}[{index}]")


def check_focal(key: str, focal: float, refuse: Refusal) -> None:
    """Pixels.

    >>> check_focal("focal_px", 1e-300, Refusal("dataset.yaml", "."))
    Traceback (most recent call last):
    factorlib.errors.InputError: dataset.yaml: focal_px: a focal length of 1e-300 px
      give pixels, from 1 to 1e+07, or leave it out
    """
    if focal <= 0:
        refuse(key, f"a focal length of {focal}", "give pixels, more than 0, or leave it out")
    if not FOCAL_PX[0] <= focal <= FOCAL_PX[1]:
        fault = f"a focal length of {focal:g} px"
        refuse(key, fault, f"give pixels, from {FOCAL_PX[0]:g} to {FOCAL_PX[1]:g}, or leave it out")


def check_centre(key: str, centre: Sequence[float], refuse: Refusal) -> None:
    """A principal point, pixels."""
    if not max(map(abs, centre)) <= CENTRE_PX:
        found = f"a principal point at ({centre[0]:g}, {centre[1]:g})"
        refuse(
            key,
            found,
            f"it is in pixels from the photo's upper left corner, at most {CENTRE_PX:g} away; without the key it is the middle",
        )


def check_unit(key: str, number: float, refuse: Refusal) -> None:
    """A ratio of two units of length, more than 0 and within UNITS."""
    if number <= 0:
        refuse(key, f"{number} is not more than 0", "give how many units of the one are one of the other")
    if not UNITS[0] <= number <= UNITS[1]:
        refuse(key, f"{number:g} units of the one in one of the other", f"give {UNITS[0]:g} to {UNITS[1]:g}")


def check_share(key: str, number: float, refuse: Refusal) -> None:
    """A reflectance or a roughness."""
    if not 0 <= number <= 1:
        refuse(
            key, f"{number:g} is not between 0 and 1", "reflectance (linear, not 0 to 255) and roughness are fractions"
        )


def check_rotation(key: str, rows: tuple, refuse: Refusal) -> None:
    """Three rows of a rotation matrix: RᵀR = 1 within ROTATION_TOLERANCE, determinant +1."""
    gram = [[sum(r[i] * r[j] for r in rows) - (i == j) for j in range(3)] for i in range(3)]
    worst = max(abs(entry) for row in gram for entry in row)
    if not worst <= ROTATION_TOLERANCE:
        fault = f"not a rotation: RᵀR differs from 1 by {worst:.3g}"
        refuse(key, fault, "its columns must be unit vectors at right angles (no scale)")
    a, b, c = rows
    determinant = sum(a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3]) for i in range(3))
    if determinant < 0:
        fault = "not a rotation but a reflection (determinant −1)"
        refuse(key, fault, "one axis is flipped: the camera frame is x right, y down, z forward")
