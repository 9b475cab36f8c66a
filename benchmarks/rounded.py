"""Numbers as people write them."""

from __future__ import annotations

import re


def exact(value: float, digits: int = 2) -> str:
    """That many significant digits, powers of ten for what is tiny or huge.

    >>> exact(0.00123), exact(0.000012), exact(0.0), exact(12.3), exact(48000.0)
    ('.0012', '1.2·10⁻⁵', '0', '12', '4.8·10⁴')
    """
    if value == 0:
        return "0"
    value = float(f"{value:.{digits}g}")
    if 1e-3 <= abs(value) < 1e4:
        text = f"{value:.10f}".rstrip("0").rstrip(".")
        return re.sub(r"^(-?)0\.", r"\1.", text)
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
