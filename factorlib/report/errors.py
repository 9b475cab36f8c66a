"""The tables of errors against truth, each number beside what a null scores."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from factorlib.report.text import number, percent
from factorlib.results.materials import Vec3
from factorlib.results.metrics import (
    ComparedMaterial,
    Kinds,
    LightErrors,
    MaterialErrors,
    Metrics,
    NormalError,
    PictureError,
    PoseError,
    Relighting,
    Resynthesis,
    ScoredLight,
)

T = TypeVar("T")

GAUGES = {"none": "nothing scaled", "scalar_per_set": "one scalar for the set", "channel_per_photo": "one per channel and picture"}
KINDS = {
    "in_true_light": "recovered material, true light",
    "in_estimated_light": "recovered material, recovered light",
    "null_grey": "null: grey ball, true light",
    "null_mean_colour": "null: mean colour",
}
VIEWS = {
    "mirror": "mirror sphere",
    "glossy": "glossy sphere",
    "lambertian": "Lambertian sphere",
    "map_all": "map, all directions",
    "map_mirrored": "map, where a pixel mirrors it",
    "map_unmirrored": "map, elsewhere",
}
CAPTIONS = {
    "resynthesis": "Over the pixels that count: mask and mesh agree, not clipped. The null paints each material of each photo in its "
    "own mean colour.",
    "materials": "Roughness: absolute. Colours: the worst channel's relative error, after the one factor per channel that all linked "
    "materials share. The null is a grey ball (diffuse 0.5, specular 0.05, roughness 0.5) with its own factor. The mean is over channels.",
    "relighting": "Balls against balls of the true material in the true light, mean over balls. A factor per channel and picture "
    "flatters everything, the grey ball too: read a number only against its null.",
    "unobserved": "The same over the pairs that were never seen together: what the joint solve predicts.",
    "light": "White spheres lit by the recovered and by the true light. RMSE as a fraction of the truth's root mean square (black "
    "scores 1). The null is a constant light of the true mean colour. Mirrored: directions that some pixel reflects into the camera.",
    "normals": "Angle over the observed pixels. The null faces the camera everywhere.",
    "poses": "A symmetric shape can be far off in rotation and right in every pixel: see the normals. Null: a random rotation, on average.",
}


class Table(msgspec.Struct, frozen=True):
    """head: column titles; rows: cells as text, the first one a row title; nulls: rows that are nulls, by index."""

    key: str
    title: str
    caption: str
    head: list[str]
    rows: list[list[str]]
    nulls: list[int] = []


def error_tables(metrics: Metrics, photos: list[str], materials: list[str]) -> list[Table]:
    """Of what the metrics have, in the set's order of photos and materials; re-synthesis always."""
    made = [
        _resynthesis(metrics.resynthesis, photos),
        _materials(metrics.materials, materials),
        _relighting(metrics.relighting),
        _unobserved(metrics.relighting),
        _light(metrics.light),
        _normals(metrics.normals, photos),
        _poses(metrics.poses, photos),
    ]
    return [table for table in made if table]


def _ordered(found: dict[str, T], order: list[str]) -> list[tuple[str, T]]:
    return [(name, found[name]) for name in order if name in found]


def _picture(error: PictureError) -> list[str]:
    return [number(error.psnr_linear_db, 1), number(error.psnr_tonemapped_db, 1), number(error.dssim, 4)]


def _by_gauge(rows: list[tuple[str, dict[str, PictureError]]]) -> list[list[str]]:
    return [[name, *(cell for g in GAUGES for cell in _picture(by_gauge[g]))] for name, by_gauge in rows]


PICTURE_HEAD = ["", *(f"{what}|{title}" for title in GAUGES.values() for what in ("PSNR lin., dB", "PSNR, dB", "DSSIM"))]


def _resynthesis(found: Resynthesis, order: list[str]) -> Table | None:
    if not found.mean:
        return None
    photos = {n: p.gauges for n, p in _ordered(found.photos, order) if p.gauges}
    rows = [(n, {g: s.estimate for g, s in by.items()}) for n, by in photos.items()]
    rows.append(("mean", {g: s.estimate for g, s in found.mean.items()}))
    rows.append(("null: flat colours, mean", {g: s.null for g, s in found.mean.items()}))
    return Table("resynthesis", "Re-synthesis against the photos", CAPTIONS["resynthesis"], PICTURE_HEAD, _by_gauge(rows), [len(rows) - 1])


def _materials(found: MaterialErrors | None, order: list[str]) -> Table | None:
    if not found:
        return None
    rows = [_material(name, m) for name, m in _ordered(found.materials, order)]
    colours = [percent(getattr(found, f"{null}mean_{part}")) for part in ("diffuse", "specular") for null in ("", "null_")]
    rows.append(["mean", "", "", number(found.mean_roughness, 3), number(found.null_mean_roughness, 3), *colours])
    head = ["", *(f"{what}|roughness" for what in ("true", "found", "error", "null"))]
    head += [f"{what}|{part}" for part in ("diffuse", "specular") for what in ("error", "null")]
    return Table("materials", "Materials against the truth", CAPTIONS["materials"], head, rows)


def _material(name: str, m: ComparedMaterial) -> list[str]:
    roughness = [m.truth.roughness, m.estimate.roughness, m.error.roughness, m.null.roughness]
    colours = [_worst(getattr(error, part)) for part in ("diffuse", "specular") for error in (m.error, m.null)]
    return [name, *(number(r, 3) for r in roughness), *colours]


def _worst(errors: Vec3) -> str:
    return percent(max(errors, key=abs))


def _kinds(key: str, title: str, mean: dict[str, Kinds]) -> Table:
    rows = [(name, {g: mean[g][kind] for g in GAUGES}) for kind, name in KINDS.items()]
    return Table(key, title, CAPTIONS[key], PICTURE_HEAD, _by_gauge(rows), [2, 3])


def _relighting(found: Relighting | None) -> Table | None:
    return _kinds("relighting", "Relighting, all pairs of material and light", found.mean) if found else None


def _unobserved(found: Relighting | None) -> Table | None:
    if not found or not found.mean_unobserved:
        return None
    return _kinds("unobserved", "Relighting, only pairs that no photo shows", found.mean_unobserved)


def _light(found: LightErrors | None) -> Table | None:
    if not found:
        return None
    head = ["", *(f"{what}|{title}" for title in GAUGES.values() for what in ("RMSE", "null"))]
    head += ["RMSE|own best factor", "null|own best factor", "angle|RGB", "null|RGB"]
    rows = [_view(title, {g: found.mean[g][v] for g in GAUGES}) for v, title in VIEWS.items() if v in found.mean["none"]]
    return Table("light", "Light: three spheres and the map itself", CAPTIONS["light"], head, rows)


def _view(title: str, scored: dict[str, ScoredLight]) -> list[str]:
    plain = scored["none"].estimate, scored["none"].null
    cells = [number(error.rmse, 3) for g in GAUGES for error in (scored[g].estimate, scored[g].null)]
    cells += [number(error.rmse_scale_invariant, 3) for error in plain]
    return [title, *cells, *(number(error.rgb_angle_deg, 1) + "°" for error in plain)]


def _normals(found: dict[str, NormalError] | None, order: list[str]) -> Table | None:
    if not found:
        return None
    rows = [
        [name, *(number(deg, 2) + "°" for deg in (e.estimate.median_deg, e.null.median_deg, e.estimate.p90_deg, e.null.p90_deg))]
        for name, e in _ordered(found, order)
    ]
    head = ["", "found|median", "null|median", "found|90th percentile", "null|90th percentile"]
    return Table("normals", "Normals against the truth", CAPTIONS["normals"], head, rows)


def _poses(found: dict[str, dict[str, PoseError]] | None, order: list[str]) -> Table | None:
    if not found:
        return None
    every = [(f"{p} · {o}", e) for p, objects in _ordered(found, order) for o, e in objects.items()]
    rows = [
        [name, number(e.rotation_deg, 2) + "°", number(e.null_rotation_deg, 1) + "°", percent(e.translation_relative, 2)]
        for name, e in every
    ]
    return Table("poses", "Poses against the truth", CAPTIONS["poses"], ["", "rotation", "null", "translation / distance"], rows)
