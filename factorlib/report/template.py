"""Rendering of this package's templates, which hold the text of the pages."""

import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import jinja2
import msgspec
import numpy as np

from factorlib.images.tone import srgb_encode
from factorlib.results.metrics import Metrics

MINUS = "\u2212"
DASH = "\u2013"


def render_template(template: str, **context: Any) -> str:
    """Render a template; values are escaped, except in templates that end in .txt."""
    folder = files("factorlib.report") / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
        autoescape=lambda name: not (name or "").endswith(".txt"),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {each.__name__: each for each in (number, significant, percent, duration, css_colour)}
    environment.filters |= {
        "in_script": _in_script,
        "plain": lambda value: f"{value:.6g}",
        "worst": lambda values: max(values, key=abs),
    }
    environment.tests["of_a_parameter"] = lambda change: ": parameter " in change
    return environment.get_template(template).render(context)


def sentences(template: str, **context: Any) -> list[str]:
    """Render a template of sentences and return its lines that are not empty."""
    return list(filter(None, render_template(template, **context).split("\n")))


def headlines(metrics: Metrics) -> list[dict[str, str]]:
    """Return the headline numbers: re-synthesis, if pixels count, and materials and relighting, if there is a truth.

    They are in words: label, value and unit, the number `beside` which it stands, and its `meaning` for a lay reader.
    """
    keys = ("label", "value", "unit", "beside", "meaning")
    return [dict(zip(keys, line.split(" | "), strict=True)) for line in sentences("headlines.txt", metrics=metrics)]


def _in_script(value: Mapping) -> str:
    """Return JSON that is safe inside a script element: no name in it can contain `</script>`."""
    text = msgspec.json.encode(value).decode("utf-8")
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def number(value: float | None, digits: int = 2) -> str:
    """Format with fixed digits and a true minus sign; a dash for an unknown value.

    >>> number(-0.1234, 2), number(None)
    ('−0.12', '–')
    """
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{digits}f}".replace("-", MINUS)


def significant(value: float | None, digits: int = 3) -> str:
    """Format with significant digits, without an exponent for sizes from 1e-4 to 1e6.

    >>> significant(0.012345), significant(12345.0), significant(0.0)
    ('0.0123', '12300', '0')
    """
    if value is None or not math.isfinite(value) or value == 0:
        return "0" if value == 0 else DASH
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}".replace("-", MINUS)
    places = digits - 1 - math.floor(math.log10(abs(value)))
    return number(round(value, places), max(0, places))


def percent(fraction: float | None, digits: int = 1) -> str:
    """Format a fraction in percent.

    >>> percent(0.0423)
    '4.2 %'
    """
    return DASH if fraction is None else f"{number(100 * fraction, digits)} %"


def duration(seconds: float | None) -> str:
    """Format seconds, as minutes and seconds from one minute on.

    >>> duration(4.31), duration(75)
    ('4.3 s', '1 min 15 s')
    """
    if seconds is None:
        return DASH
    return f"{seconds:.1f} s" if seconds < 60 else f"{round(seconds) // 60} min {round(seconds) % 60:02d} s"


def css_colour(linear: Sequence[float]) -> str:
    """Return a reflectance as a CSS colour: sRGB-encoded, clamped to [0, 1].

    >>> css_colour([1.0, 0.18, 0.0])
    'rgb(255 118 0)'
    """
    return f"rgb({' '.join(str(round(255 * v)) for v in srgb_encode(np.clip(linear, 0.0, 1.0)).tolist())})"
