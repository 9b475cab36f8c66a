"""Numbers as the page prints them."""

from __future__ import annotations

import math

import numpy as np

from factorlib.images.transfer import srgb_encode

MINUS, DASH = "\u2212", "\u2013"


def number(value: float | None, digits: int = 2) -> str:
    """Fixed digits, a true minus, a dash for what is not known.

    >>> number(-0.1234, 2), number(None)
    ('\u22120.12', '\u2013')
    """
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{digits}f}".replace("-", MINUS)


def significant(value: float | None, digits: int = 3) -> str:
    """That many significant digits, without an exponent for everyday sizes.

    >>> significant(0.012345), significant(12345.0), significant(0.0)
    ('0.0123', '12300', '0')
    """
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}".replace("-", MINUS)
    places = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, places):.{max(0, places)}f}".replace("-", MINUS)


def percent(fraction: float | None, digits: int = 1) -> str:
    """A fraction in percent.

    >>> percent(0.0423)
    '4.2 %'
    """
    return DASH if fraction is None else f"{number(100 * fraction, digits)}\u202f%".replace("\u202f", " ")


def duration(seconds: float | None) -> str:
    """Seconds, or minutes and seconds.

    >>> duration(4.31), duration(75)
    ('4.3 s', '1 min 15 s')
    """
    if seconds is None:
        return DASH
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60:02d} s"


def css_colour(linear: list[float]) -> str:
    """A reflectance as a CSS colour: sRGB-encoded, cut to [0, 1].

    >>> css_colour([1.0, 0.18, 0.0])
    'rgb(255 118 0)'
    """
    return f"rgb({' '.join(str(round(255 * v)) for v in srgb_encode(np.clip(linear, 0.0, 1.0)).tolist())})"
