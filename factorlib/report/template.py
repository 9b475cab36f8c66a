"""Templates of this package: they hold the words of the pages, and this module prints numbers into them."""

import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import jinja2
import msgspec
import numpy as np

from factorlib.images.transfer import srgb_encode
from factorlib.results.metrics import Metrics

MINUS, DASH = "\u2212", "\u2013"


def rendered(template: str, **context: Any) -> str:
    """A template with what it is about filled in; text is escaped, but in templates that end in .txt."""
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
        "in_script": _in_script, "plain": lambda value: f"{value:.6g}", "worst": lambda values: max(values, key=abs),
    }  # fmt: skip
    environment.tests["of_a_parameter"] = lambda change: ": parameter " in change
    return environment.get_template(template).render(context)


def sentences(template: str, **context: Any) -> list[str]:
    """The lines of a template of sentences that are not empty."""
    return list(filter(None, rendered(template, **context).split("\n")))


class Headline(msgspec.Struct, frozen=True):
    """A number in words; beside: what it is compared with; meaning: a sentence for who does not know the measure."""

    label: str
    value: str
    unit: str
    beside: str
    meaning: str


def headlines(metrics: Metrics) -> list[Headline]:
    """Re-synthesis where a pixel counts; materials and relighting where there is a truth."""
    return [Headline(*line.split(" | ")) for line in sentences("headlines.txt", metrics=metrics)]


def _in_script(value: Mapping) -> str:
    """JSON that no `</script>` in a name can end."""
    text = msgspec.json.encode(value).decode("utf-8")
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def number(value: float | None, digits: int = 2) -> str:
    """Fixed digits, a true minus, a dash for what is not known.

    >>> number(-0.1234, 2), number(None)
    ('\u22120.12', '\u2013')
    """
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{digits}f}".replace("-", MINUS)


def significant(value: float | None, digits: int = 3) -> str:
    """Write a number with that many significant digits, without an exponent for everyday sizes.

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
    """A fraction in percent.

    >>> percent(0.0423)
    '4.2 %'
    """
    return DASH if fraction is None else f"{number(100 * fraction, digits)} %"


def duration(seconds: float | None) -> str:
    """Seconds, or minutes and seconds.

    >>> duration(4.31), duration(75)
    ('4.3 s', '1 min 15 s')
    """
    if seconds is None:
        return DASH
    return f"{seconds:.1f} s" if seconds < 60 else f"{round(seconds) // 60} min {round(seconds) % 60:02d} s"


def css_colour(linear: Sequence[float]) -> str:
    """A reflectance as a CSS colour: sRGB-encoded, cut to [0, 1].

    >>> css_colour([1.0, 0.18, 0.0])
    'rgb(255 118 0)'
    """
    return f"rgb({' '.join(str(round(255 * v)) for v in srgb_encode(np.clip(linear, 0.0, 1.0)).tolist())})"
