"""The rows of the table of materials."""

from __future__ import annotations

import msgspec

from factorlib.report.appearance import Cell
from factorlib.report.artifacts import Artifacts
from factorlib.report.forms import forms
from factorlib.report.text import css_colour, number, significant
from factorlib.results.materials import Channels, Solved


class Colour(msgspec.Struct, frozen=True):
    """A reflectance: as a swatch, as three numbers, and their standard errors."""

    css: str
    values: list[str]
    errors: list[str]


class MaterialRow(msgspec.Struct, frozen=True):
    """One solved material: its ball, its reflectance and roughness, and how many pixels of how many photos show it; tag: its CSS colour."""

    name: str
    tag: str
    ball: Cell | None
    diffuse: Colour
    specular: Colour
    roughness: float
    roughness_text: str
    roughness_error: str
    roughness_span: tuple[float, float]  # percent of the scale 0 to 1: one standard error each way
    pixels: int
    photos: int
    forms: dict[str, str]  # by program: text to copy


def material_rows(run: Artifacts, cells: list[list[Cell]], tags: dict[str, str]) -> list[MaterialRow]:
    """In the order of the set; a material that was not solved has no row."""
    solved = run.solved().materials
    counts = {m: {p: f.pixels.get(m, 0) for p, f in run.photo_facts().items()} for m in run.set.materials}
    named = zip(run.set.materials, cells, strict=True)
    exported = run.exported()
    return [_row(tags[name], solved[name], counts[name], row, forms(name, exported.get(name, solved[name]).reflectance)) for name, row in named if name in solved]


def _row(tag: str, found: Solved, counts: dict[str, int], cells: list[Cell], copies: dict[str, str]) -> MaterialRow:
    roughness, error = found.roughness, found.stderr.roughness
    span = (max(0.0, roughness - error), min(1.0, roughness + error))
    shown = max((c for c in cells if c.uri), key=lambda c: counts.get(c.photo, 0), default=None)
    return MaterialRow(
        name=cells[0].material, tag=tag, ball=shown, diffuse=_colour(found.diffuse, found.stderr.diffuse),
        specular=_colour(found.specular, found.stderr.specular), roughness=roughness, roughness_text=number(roughness, 3),
        roughness_error=significant(error, 2),
        roughness_span=(100 * span[0], max(0.5, 100 * (span[1] - span[0]))),
        pixels=sum(counts.values()), photos=sum(n > 0 for n in counts.values()),
        forms=copies,
    )  # fmt: skip


def _colour(values: Channels, errors: Channels) -> Colour:
    return Colour(css_colour(values), [number(v, 3) for v in values], [significant(e, 2) for e in errors])
