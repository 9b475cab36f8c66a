"""Everything on the page, gathered and set into the template."""

from __future__ import annotations

from importlib.resources import files
from itertools import groupby
from typing import Any

import jinja2
import msgspec

from factorlib.images.picture import read_png
from factorlib.report import text
from factorlib.report.appearance import Cell, balls, exposures, light_row, reflectance_maps
from factorlib.report.artifacts import Artifacts
from factorlib.report.choices import choices
from factorlib.report.errors import error_tables
from factorlib.report.forms import forms
from factorlib.report.headlines import LOW_IOU, cautions, headlines
from factorlib.report.photos import AMPLIFICATION, PhotoRow, longest_side
from factorlib.report.plot import Series, line_plot
from factorlib.report.png import box_of, data_uri, reduced
from factorlib.report.training import training_of
from factorlib.report.viewer import Viewed
from factorlib.results.poses import AS_IT_IS

STAGES = ["masks", "align", "urm", "train", "solve", "export", "render", "evaluate"]
FILTERS = ("number", "significant", "percent", "duration", "css_colour")
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
    metrics, exposure, facts, solved = run.metrics(), exposures(run), run.photo_facts(), run.solved()
    cells = balls(run, {p: [m for m, n in f.pixels.items() if n > 0] for p, f in facts.items()}, exposure)
    errors = metrics.light.lights if metrics.light else {}
    lights = [light_row(run, name, photos, errors.get(name)) for name, photos in run.illuminations().items()]
    reasons = sorted((why, section) for section, why in metrics.reasons.items())
    return rendered(
        "index.html",
        contents=list(CONTENTS.items()),
        set=run.set,
        metrics=metrics,
        headlines=headlines(metrics),
        cautions=cautions(run, metrics),
        rows=rows,
        amplification=AMPLIFICATION,
        tags=tags,
        materials=_materials(run, cells),
        cells=cells,
        maps=[(p, reflectance_maps(run, p, exposure[p])) for p in run.set.photos],
        lights=[row for row in lights if row],
        missing={why: [section for _, section in group] for why, group in groupby(reasons, lambda pair: pair[0])},
        errors=error_tables(metrics, run.set.photos, run.set.materials),
        gauge=msgspec.to_builtins(solved.gauge, order="sorted"),
        choices=choices(solved.model),
        model=msgspec.to_builtins(solved.model, order="sorted"),
        exposures={p: f for p, f in run.exposures().items() if any(abs(c - 1) > 1e-9 for c in f)},
        plots=_plots(run.table("solve", "convergence")),
        poses=[(p, _overlay(run, p), entry, facts.get(p)) for p in run.set.photos if (entry := run.poses().get(p))],
        low_iou=LOW_IOU,
        as_it_is=AS_IT_IS,
        training=training_of(run),
        cost=cost_of(run.events(), STAGES),
        viewed=viewed,
    )


def rendered(template: str, **context: Any) -> str:
    """A template of this package with what it is about filled in; text is escaped."""
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    folder = files("factorlib.report") / "templates"
    environment.loader = jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8"))
    environment.filters |= {name: getattr(text, name) for name in FILTERS} | {"in_script": _in_script}
    environment.tests["of_a_parameter"] = lambda change: ": parameter " in change or ": default of parameter " in change
    environment.globals["grouped"] = _grouped
    return environment.get_template(template).render(context)


def _in_script(value: msgspec.Struct) -> str:
    """JSON that no `</script>` in a name can end."""
    text = msgspec.json.encode(value).decode("utf-8")
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _grouped(head: list[str]) -> list[tuple[str, int]]:
    """The second line of a table's head, "what|group": groups and their widths, in order."""
    groups = [title.partition("|")[2] for title in head]
    return [(name, len(list(run))) for name, run in groupby(groups)]


def _materials(run: Artifacts, cells: list[list[Cell]]) -> list[dict[str, Any]]:
    """What the table says of each material that was solved; ball: in the light of the photo that shows it most."""
    solved, exported, facts = run.solved().materials, run.exported(), run.photo_facts()
    rows = []
    for name, row in zip(run.set.materials, cells, strict=True):
        if name in solved:
            counts = {photo: fact.pixels.get(name, 0) for photo, fact in facts.items()}
            ball = max((c for c in row if c.uri), key=lambda c: counts.get(c.photo, 0), default=None)
            copies = forms(name, exported.get(name, solved[name]).reflectance)
            rows.append({"name": name, "found": solved[name], "ball": ball, "counts": counts, "forms": copies})
    return rows


def _overlay(run: Artifacts, photo: str) -> str | None:
    """The mesh drawn over the photo, cut to its objects."""
    pixels = run.read(read_png, "align", f"{photo}_overlay.png")
    if pixels is None:
        return None
    label = run.exr("masks", photo)["label"] > 0.5
    crop = pixels[box_of(label, 0.15)] if label.shape == pixels.shape[:2] else pixels
    return data_uri(reduced(crop.astype("f4"), longest_side(len(run.set.photos))).round().astype("u1"))


def _plots(history: dict[str, list]) -> list[tuple[str, list[str]]]:
    """(SVG, names of its lines) of the solve's history."""
    if not history:
        return []
    steps = list(range(len(history["loss"])))
    rounds = [k for k in steps[1:] if history["round"][k] != history["round"][k - 1]]
    named = {"loss": "loss", "held out": "held_out"}
    losses = [Series(name, steps, history[column]) for name, column in named.items() if column in history]
    count = [Series("lobes", steps, history["lobes"])]
    return [
        (line_plot(losses, "accepted step", "loss", log_y=True, steps=rounds), [s.name for s in losses]),
        (line_plot(count, "accepted step", "light lobes, all lights", steps=rounds), ["lobes"]),
    ]


# ── Cost ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


class StageCost(msgspec.Struct, frozen=True):
    """seconds: wall time summed over the stage's steps;  longest: of its longest step;  memory_mb: largest peak of any."""

    stage: str
    steps: int
    seconds: float
    longest: float
    cpu_seconds: float | None
    memory_mb: float | None


class Cost(msgspec.Struct, frozen=True):
    """machines: the different ones that steps ran on, in words;  warnings: in the order of the stages, each once."""

    stages: list[StageCost]
    machines: list[str]
    warnings: list[tuple[str, str]]


def cost_of(events: list[dict], order: list[str]) -> Cost:
    """What each stage cost, the last time each step ran: the only part of the page that differs from run to run.

    A line of the log is {"event": "done", "stage", "photo", "seconds", "cpu_seconds", "memory_mb", "machine", …} for a step, or
    {"event": "warning", "stage", "photo", "text"}; stages in the order given.
    """
    last = {(e["stage"], e.get("photo")): e for e in events if e.get("event") == "done" and "seconds" in e}
    by_stage = {s: [e for (stage, _), e in last.items() if stage == s] for s in order}
    machines = sorted({_machine(e["machine"]) for e in last.values() if e.get("machine")})
    warned = {(e.get("stage") or "", e["text"]) for e in events if e.get("event") == "warning" and e.get("text")}
    ranked = sorted(warned, key=lambda w: (order.index(w[0]) if w[0] in order else len(order), w[1]))
    return Cost([_stage_cost(stage, steps) for stage, steps in by_stage.items() if steps], machines, ranked)


def _stage_cost(stage: str, steps: list[dict]) -> StageCost:
    names = ("seconds", "cpu_seconds", "memory_mb")
    seconds, cpu, memory = ([float(e[name]) for e in steps if e.get(name) is not None] for name in names)
    busy, peak = sum(cpu) if cpu else None, max(memory, default=None)
    return StageCost(stage, len(steps), sum(seconds), max(seconds), busy, peak)


def _machine(machine: dict) -> str:
    cores, python = machine.get("cores"), machine.get("python")
    words = [machine.get("system"), machine.get("processor"), cores and f"{cores} cores", python and f"Python {python}"]
    return ", ".join(word for word in words if word)
