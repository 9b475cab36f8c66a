"""Figures as SVG files that stand alone: a white page, its own style, text that any viewer has a font for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

COLOURS = ("#c2562b", "#2b5c9e", "#3f8f5b", "#8a4f9e", "#8b6d1f", "#5b6068")
INK, SOFT, LINE = "#1b1d21", "#5b6068", "#d9dce1"
STYLE = f"""text {{ font: 12px system-ui, 'DejaVu Sans', sans-serif; fill: {INK}; }}
.soft {{ fill: {SOFT}; }} .small {{ font-size: 11px; }} .title {{ font-weight: 600; font-size: 13px; }}
.grid, .rule {{ stroke: {LINE}; stroke-width: .7; }} .axis {{ stroke: {SOFT}; }}"""


def page(width: float, height: float, parts: Sequence[str]) -> str:
    """The figure of these parts, on white."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}">\n'
        f'<style>{STYLE}</style>\n<rect width="100%" height="100%" fill="#ffffff"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


def text(x: float, y: float, words: str, anchor: str = "start", css: str = "", turn: float = 0) -> str:
    """Words; turn: in degrees about (x, y)."""
    turned = f' transform="rotate({turn:g} {x:.1f} {y:.1f})"' if turn else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" class="{css}"{turned}>{escape(words)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, css: str = "", style: str = "") -> str:
    """A straight line."""
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" class="{css}" style="{style}"/>'


def dot(x: float, y: float, colour: str, *, hollow: bool = False, radius: float = 4.5) -> str:
    """A full or hollow circle."""
    fill = "#ffffff" if hollow else colour
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}" stroke="{colour}" stroke-width="1.8"/>'


def path(points: Sequence[tuple[float, float]], colour: str, dashed: bool = False) -> str:
    """Straight lines from point to point."""
    at, dashes = " ".join(f"{x:.1f},{y:.1f}" for x, y in points), ' stroke-dasharray="4 3"' if dashed else ""
    return f'<polyline points="{at}" fill="none" stroke="{colour}" stroke-width="1.8"{dashes}/>'


class LogAxis(NamedTuple):
    """Where the logarithm of a value stands between two pixels, `start` of the value `low` and `end` of `high`."""

    low: float
    high: float
    start: float
    end: float
    log = staticmethod(math.log10)

    def __call__(self, value: float) -> float:
        """The pixel of a value."""
        share = (self.log(max(value, 1e-300)) - self.log(self.low)) / (self.log(self.high) - self.log(self.low))
        return self.start + share * (self.end - self.start)

    def decades(self) -> list[float]:
        """The powers of ten between both ends."""
        first, last = math.ceil(self.log(self.low) - 1e-9), math.floor(self.log(self.high) + 1e-9)
        return [10.0**k for k in range(first, last + 1)]
