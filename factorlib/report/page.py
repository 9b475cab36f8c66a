"""Everything on the page, gathered and set into the template."""

from __future__ import annotations

from importlib.resources import files
from itertools import groupby
from typing import Any

import jinja2
import msgspec

from factorlib.report import text
from factorlib.report.appearance import balls, exposures, light_row, reflectance_maps
from factorlib.report.artifacts import Artifacts
from factorlib.report.choices import choices
from factorlib.report.cost import cost_of
from factorlib.report.errors import error_tables
from factorlib.report.headlines import cautions, headlines
from factorlib.report.materials import material_rows
from factorlib.report.photos import AMPLIFICATION, PhotoRow
from factorlib.report.plot import Series, line_plot
from factorlib.report.poses import pose_rows
from factorlib.report.training import training_of
from factorlib.report.viewer import Viewed
from factorlib.results.materials import Channels

STAGES = ["masks", "align", "urm", "train", "solve", "export", "render", "evaluate"]
CONTENTS = {
    "summary": "Summary",
    "relight": "Relight",
    "photos": "Photos",
    "materials": "Materials",
    "appearance": "Materials × lights",
    "reflectance": "Reflectance maps",
    "lights": "Environment maps",
    "errors": "Errors",
    "solve": "Solve",
    "poses": "Poses",
    "training": "Reflection operator",
    "cost": "Cost",
}


def page(run: Artifacts, rows: list[PhotoRow], tags: dict[str, str], viewed: Viewed | None) -> str:
    """The page as HTML, from the artifacts, the photos' rows, the materials' colours and what can be relit."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {name: getattr(text, name) for name in ("number", "significant", "percent", "duration")}
    folder = files("factorlib.report") / "templates"
    environment.loader = jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8"))
    environment.filters["in_script"] = _in_script
    environment.globals["grouped"] = _grouped
    return environment.get_template("index.html").render(_context(run, rows, tags), viewed=viewed)


def _in_script(value: msgspec.Struct) -> str:
    """JSON that no `</script>` in a name can end."""
    text = msgspec.json.encode(value).decode("utf-8")
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _grouped(head: list[str]) -> list[tuple[str, int]]:
    """The second line of a table's head, "what|group": groups and their widths, in order."""
    groups = [title.partition("|")[2] for title in head]
    return [(name, len(list(run))) for name, run in groupby(groups)]


def _context(run: Artifacts, rows: list[PhotoRow], tags: dict[str, str]) -> dict[str, Any]:
    metrics = run.metrics()
    exposure, seen = exposures(run), {p: [m for m, n in f.pixels.items() if n > 0] for p, f in run.photo_facts().items()}
    cells = balls(run, seen, exposure)
    errors_of_light, solved = metrics.light.lights if metrics.light else {}, run.solved()
    return {
        "contents": list(CONTENTS.items()),
        "set": run.set,
        "metrics": metrics,
        "headlines": headlines(metrics),
        "cautions": cautions(run, metrics),
        "rows": rows,
        "amplification": AMPLIFICATION,
        "tags": tags,
        "materials": material_rows(run, cells, tags),
        "cells": cells,
        "maps": [(p, reflectance_maps(run, p, exposure[p])) for p in run.set.photos],
        "lights": [r for n, p in run.illuminations().items() if (r := light_row(run, n, p, errors_of_light.get(n)))],
        "missing": _by_reason(metrics.reasons),
        "errors": error_tables(metrics, run.set.photos, run.set.materials),
        "gauge": _sorted(solved.gauge),
        "choices": choices(solved.model),
        "model": _sorted(solved.model),
        "exposures": _shared_exposures(run),
        "plots": _plots(run.convergence()),
        "poses": pose_rows(run),
        "training": training_of(run),
        "cost": cost_of(run.events(), STAGES),
    }


def _sorted(part: msgspec.Struct) -> dict[str, Any]:
    """A part of materials.json as it stands there."""
    return msgspec.to_builtins(part, order="sorted")


def _by_reason(reasons: dict[str, str]) -> dict[str, list[str]]:
    return {reason: sorted(s for s, why in reasons.items() if why == reason) for reason in sorted(set(reasons.values()))}


def _shared_exposures(run: Artifacts) -> dict[str, Channels]:
    """Factors of photos on the light they share; those that are 1 say nothing."""
    found = run.exposures()
    return {photo: factor for photo, factor in found.items() if any(abs(f - 1) > 1e-9 for f in factor)}


def _plots(history: dict[str, list]) -> list[tuple[str, list[str]]]:
    """(SVG, names of its lines) of the solve's history."""
    if not history:
        return []
    steps = list(range(len(history["loss"])))
    rounds = [k for k in steps[1:] if history["round"][k] != history["round"][k - 1]]
    losses = [Series("loss", steps, history["loss"])]
    if "held_out" in history:
        losses.append(Series("held out", steps, history["held_out"]))
    return [
        (line_plot(losses, "accepted step", "loss", log_y=True, steps=rounds), [s.name for s in losses]),
        (line_plot([Series("lobes", steps, history["lobes"])], "accepted step", "light lobes, all lights", steps=rounds), ["lobes"]),
    ]
