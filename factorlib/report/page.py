"""Content of the report's page, collected and rendered into the template."""

import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any
from urllib.parse import quote

from factorlib.evaluate.predicted_views import describe_views
from factorlib.export.gltf_writer import EXTENSION, gltf_material
from factorlib.export.materialx import materialx
from factorlib.export.mitsuba import material_xml
from factorlib.images.picture import data_uri, read_png
from factorlib.inference.choices.suns import LEAST_SUN_SHARE
from factorlib.report import pictures
from factorlib.report.artifacts import STAGES, Artifacts
from factorlib.report.template import headlines, render_template, sentences
from factorlib.results.materials import Reflectance
from factorlib.results.metrics import Metrics

LOW_IOU = 0.85  # silhouette overlap below which a pose is doubted
FILES = {  # links of the page: stage and pattern of its files
    "materials.json": ("export", "materials.json"), "MaterialX": ("export", "*.mtlx"),
    "objects, glTF": ("export", "*.glb"),
    "lights, EXR": ("export", "illumination/*.exr"), "lights, HDR": ("export", "illumination/*.hdr"),
    "lights without their suns, EXR": ("export", "illumination/*_sky.exr"),
    "how sure lights are": ("export", "coverage/*.exr"), "Mitsuba scenes": ("export", "scenes/*.xml"),
    "Blender scenes": ("export", "scenes/blender.py"),
    "meshes": ("export", "meshes/*.ply"),
    "re-syntheses": ("render", "resynthesis/*.exr"), "metrics.json": ("evaluate", "metrics.json"),
}  # fmt: skip


def page(
    run: Artifacts,
    rows: list[pictures.PhotoRow],
    tags: dict[str, str],
    viewed: dict[str, Any] | None,
    surfaces: Sequence[Mapping[str, Any]] = (),
    first: Sequence[tuple[str, str, str]] = (),
) -> str:
    """Return the report's page as HTML.

    Args:
        run: results of the run
        rows: pictures and errors of each photo
        tags: colours of the materials, by name
        viewed: data of the relighting viewer (`factorlib.report.viewer.viewer_data`); None for no viewer
        surfaces: a row for each refined mesh (`factorlib.report.pictures.surface_rows`)
        first: pictures of the first screen: title, `data:` URI, caption
    """
    metrics = run.metrics
    assert metrics is not None
    exposure = pictures.exposures(run)
    cells = [[pictures.ball_cell(run, m, p, exposure[p]) for p in run.set.photos] for m in run.set.materials]
    return render_template(
        "index.html",
        set=run.set,
        metrics=metrics,
        headlines=headlines(metrics),
        tested=describe_views(metrics.views) if metrics.views else "",
        cautions=cautions(run, metrics),
        links=links(run),
        first=first,
        rows=rows,
        amplification=pictures.AMPLIFICATION,
        tags=tags,
        materials=_materials(run, cells),
        cells=cells,
        surface=run.surface,
        texture=run.texture,
        exchange=run.exchange,
        surfaces=surfaces,
        cost=stage_costs(run.events(), STAGES),
        viewed=viewed,
        **_facts(run, metrics),
    )


def _facts(run: Artifacts, metrics: Metrics) -> dict[str, Any]:
    """Return the page's facts about the solve, poses and lights, and the sections without numbers by the reason."""
    errors = metrics.light.lights if metrics.light else {}
    lights = (pictures.light_row(run, name, photos, errors.get(name)) for name, photos in run.illuminations().items())
    reasons = sorted((why, section) for section, why in metrics.reasons.items())
    gauge = run.solved.gauge
    numbers = sorted(set(gauge.component.values()))
    poses = run.poses
    facts = run.photo_facts
    return {
        "gauge": gauge,
        "groups": [[name for name, k in gauge.component.items() if k == number] for number in numbers],
        "choices": sentences("choices.txt", model=run.solved.model),
        "exposures": {p: f for p, f in run.exposures.items() if any(abs(c - 1) > 1e-9 for c in f)},
        "poses": [(p, _overlay(run, p), poses[p], facts.get(p)) for p in run.set.photos if p in poses],
        "doubted": any(obj.doubts or obj.left_out for photo in poses.values() for obj in photo.objects.values()),
        "low_iou": LOW_IOU,
        "lights": list(filter(None, lights)),
        "least_sun_share": LEAST_SUN_SHARE,
        "missing": {why: [name for _, name in group] for why, group in groupby(reasons, itemgetter(0))},
    }


def links(run: Artifacts) -> dict[str, list[tuple[str, str]]]:
    """Return the existing files by kind: their names, and their paths relative to the page's folder."""
    files = {}
    names = run.illuminations()
    for kind, (stage, pattern) in FILES.items():
        paths = sorted(run.folders[stage].glob(pattern))
        if kind.endswith(", EXR"):  # A light's own name may end in _sky.
            paths = [path for path in paths if (path.stem in names) == (kind == "lights, EXR")]
        if paths:
            files[kind] = [(p.stem, f"../{stage}/{quote(p.relative_to(run.folders[stage]).as_posix())}") for p in paths]
    return files


def cautions(run: Artifacts, metrics: Metrics) -> list[str]:
    """Return sentences about unreliable results, and about results no better than a guess."""
    errors = metrics.resynthesis.photos
    poses = run.poses
    facts = run.photo_facts.values()
    return sentences(
        "cautions.txt",
        metrics=metrics,
        errors={name: errors[name] for name in run.set.photos if name in errors},
        poses={name: poses[name] for name in run.set.photos if name in poses},
        low_iou=LOW_IOU,
        paint={name: each.above for name, each in (run.exported.gauge.paint or {}).items()},
        lights=len(run.illuminations()),
        pixels={name: sum(photo.pixels.get(name, 0) for photo in facts) for name in run.set.materials},
    )


def forms(name: str, material: Reflectance) -> dict[str, str]:
    """Return a material as text to paste into each program, by program name.

    Numbers are linear; docs/formats.md describes how each program interprets them.
    """
    numbers = {key: getattr(material, key) for key in ("diffuse", "specular", "roughness", "alpha")}
    gltf = gltf_material(material)
    plain = gltf["pbrMetallicRoughness"]
    specular = gltf.get("extensions", {}).get(EXTENSION)
    return {
        "numbers": json.dumps({name: numbers}),
        "Mitsuba": material_xml(name, material),
        "Blender": render_template("blender.txt", name=repr(name), material=material) + "\n",
        "MaterialX": materialx({name: material}),
        "glTF": json.dumps({"name": name, **gltf}),
        "three.js": render_template("three.txt", plain=plain, specular=specular),
    }


def _materials(run: Artifacts, cells: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return the table's row of each solved material; its ball is in the light of the photo that shows it most."""
    materials = run.exported.materials
    facts = run.photo_facts
    rows = []
    for name, row in zip(run.set.materials, cells, strict=True):
        if name in materials:
            counts = {photo: fact.pixels.get(name, 0) for photo, fact in facts.items()}
            ball = max((c for c in row if c["uri"]), key=lambda c: counts.get(c["photo"], 0), default=None)
            copies = forms(name, materials[name].reflectance)
            rows.append({"name": name, "estimate": materials[name], "ball": ball, "counts": counts, "forms": copies})
    return rows


def _overlay(run: Artifacts, photo: str) -> str | None:
    """Return the mesh drawn over the photo, cropped to its objects."""
    pixels = run.read(read_png, "align", f"{photo}_overlay.png")
    if pixels is None:
        return None
    crop = pixels[pictures.mask_box(run.channels("masks", photo)["label"] > 0.5, 0.15)].astype("f4")
    return data_uri(pictures.downsample(crop, pictures.longest_side(len(run.set.photos))).round().astype("u1"))


# ── Cost ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def stage_costs(events: list[dict], order: list[str]) -> dict[str, list]:
    """Return the cost of each stage in the last run of each step: the only part of the page that differs between runs.

    An event is {"event": "done", "stage", "photo", "seconds", "cpu_seconds", "memory_mb", "machine", …} for a step, or
    {"event": "warning", "stage", "photo", "text"}.

    The result has these keys.
    stages: in the order given, with seconds of all steps and of the longest, and peak memory
    machines: machines that steps ran on, in words
    warnings: distinct pairs (stage, text), in the order of the stages
    """
    last = {(e["stage"], e.get("photo")): e for e in events if e.get("event") == "done" and "seconds" in e}
    machines = sorted({_machine(e["machine"]) for e in last.values() if e.get("machine")})
    warned = {(e.get("stage") or "", e["text"]) for e in events if e.get("event") == "warning" and e.get("text")}
    ranked = sorted(warned, key=lambda w: (order.index(w[0]) if w[0] in order else len(order), w[1]))
    stages = []
    for stage in [stage for stage in order if any(stage == name for name, _ in last)]:
        steps = [event for (name, _), event in last.items() if name == stage]
        names = ("seconds", "cpu_seconds", "memory_mb")
        seconds, cpu, memory = ([float(e[name]) for e in steps if e.get(name) is not None] for name in names)
        sums = {"seconds": sum(seconds), "longest": max(seconds), "cpu_seconds": sum(cpu) if cpu else None}
        stages.append({"stage": stage, "steps": len(steps), **sums, "memory_mb": max(memory, default=None)})
    return {"stages": stages, "machines": machines, "warnings": ranked}


def _machine(machine: dict) -> str:
    words = {"system": "{}", "processor": "{}", "cores": "{} cores", "python": "Python {}"}
    return ", ".join(text.format(machine[key]) for key, text in words.items() if machine.get(key))
