"""The tables of errors against truth, each number beside what a null scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

import msgspec

from factorlib.report.text import number, percent
from factorlib.results.metrics import ComparedMaterial, Kinds, MaterialErrors, Metrics, PictureError, ScoredLight

T = TypeVar("T")

GAUGES = {
    "none": "nothing scaled",
    "scalar_per_set": "one scalar for the set",
    "channel_per_photo": "one per channel and picture",
}
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
PICTURE_HEAD = [
    "",
    *(f"{what}|{title}" for title in GAUGES.values() for what in ("PSNR lin., dB", "PSNR, dB", "DSSIM")),
]


class Table(msgspec.Struct, frozen=True):
    """head: column titles; rows: cells as text, the first one a row title; nulls: rows that are nulls, by index."""

    key: str
    title: str
    head: list[str]
    rows: list[list[str]]
    nulls: list[int] = []

    @property
    def caption(self) -> str:
        """What the table compares, in sentences."""
        return CAPTIONS[self.key]


def error_tables(metrics: Metrics, photos: list[str], materials: list[str]) -> list[Table]:
    """The tables of what the metrics have, in the set's order of photos and materials."""
    tables, relit = [], metrics.relighting
    if metrics.resynthesis.mean:
        scored = {n: p.gauges for n, p in _ordered(metrics.resynthesis.photos, photos) if p.gauges}
        rows = [(name, {g: s.estimate for g, s in by.items()}) for name, by in scored.items()]
        rows.append(("mean", {g: s.estimate for g, s in metrics.resynthesis.mean.items()}))
        rows.append(("null: flat colours, mean", {g: s.null for g, s in metrics.resynthesis.mean.items()}))
        title = "Re-synthesis against the photos"
        tables.append(Table("resynthesis", title, PICTURE_HEAD, _by_gauge(rows), [len(rows) - 1]))
    if metrics.materials:
        tables.append(_materials(metrics.materials, materials))
    if relit:
        tables.append(_relit("relighting", "Relighting, all pairs of material and light", relit.mean))
    if relit and relit.mean_unobserved:
        tables.append(_relit("unobserved", "Relighting, only pairs that no photo shows", relit.mean_unobserved))
    if metrics.light:
        tables.append(_light(metrics.light.mean))
    if metrics.normals:
        degrees = {n: [(e.estimate.median_deg, e.null.median_deg), (e.estimate.p90_deg, e.null.p90_deg)]
                   for n, e in _ordered(metrics.normals, photos)}  # fmt: skip
        rows = [[name, *(number(deg, 2) + "°" for pair in pairs for deg in pair)] for name, pairs in degrees.items()]
        head = ["", *(f"{who}|{what}" for what in ("median", "90th percentile") for who in ("found", "null"))]
        tables.append(Table("normals", "Normals against the truth", head, rows))
    if metrics.poses:
        every = [(f"{p} · {o}", e) for p, objects in _ordered(metrics.poses, photos) for o, e in objects.items()]
        rows = [
            [
                name,
                f"{number(e.rotation_deg, 2)}°",
                f"{number(e.null_rotation_deg, 1)}°",
                percent(e.translation_relative, 2),
            ]
            for name, e in every
        ]
        tables.append(
            Table("poses", "Poses against the truth", ["", "rotation", "null", "translation / distance"], rows)
        )
    return tables


def _ordered(entries: Mapping[str, T], order: list[str]) -> list[tuple[str, T]]:
    return [(name, entries[name]) for name in order if name in entries]


def _by_gauge(rows: Iterable[tuple[str, Mapping[str, PictureError]]]) -> list[list[str]]:
    def cells(error: PictureError) -> list[str]:
        """The three measures, as the columns of PICTURE_HEAD."""
        return [number(error.psnr_linear_db, 1), number(error.psnr_tonemapped_db, 1), number(error.dssim, 4)]

    return [[name, *(cell for g in GAUGES for cell in cells(by_gauge[g]))] for name, by_gauge in rows]


def _relit(key: str, title: str, mean: Mapping[str, Kinds]) -> Table:
    rows = [(name, {g: mean[g][kind] for g in GAUGES}) for kind, name in KINDS.items()]
    return Table(key, title, PICTURE_HEAD, _by_gauge(rows), [2, 3])


def _materials(errors: MaterialErrors, order: list[str]) -> Table:
    rows = [_material(name, m) for name, m in _ordered(errors.materials, order)]
    means = [getattr(errors, f"{null}mean_{part}") for part in ("diffuse", "specular") for null in ("", "null_")]
    roughness = [number(errors.mean_roughness, 3), number(errors.null_mean_roughness, 3)]
    rows.append(["mean", "", "", *roughness, *map(percent, means)])
    head = ["", *(f"{what}|roughness" for what in ("true", "found", "error", "null"))]
    head += [f"{what}|{part}" for part in ("diffuse", "specular") for what in ("error", "null")]
    return Table("materials", "Materials against the truth", head, rows)


def _material(name: str, m: ComparedMaterial) -> list[str]:
    """Colours: the worst channel's."""
    roughness = [m.truth.roughness, m.estimate.roughness, m.error.roughness, m.null.roughness]
    colours = [max(getattr(error, part), key=abs) for part in ("diffuse", "specular") for error in (m.error, m.null)]
    return [name, *(number(r, 3) for r in roughness), *map(percent, colours)]


def _light(mean: Mapping[str, Mapping[str, ScoredLight]]) -> Table:
    def cells(view: str) -> list[str]:
        """The errors of a view and of its null, by turns."""
        plain = mean["none"][view].estimate, mean["none"][view].null
        rmse = [error.rmse for g in GAUGES for error in (mean[g][view].estimate, mean[g][view].null)]
        rmse += [error.rmse_scale_invariant for error in plain]
        return [*(number(r, 3) for r in rmse), *(f"{number(error.rgb_angle_deg, 1)}°" for error in plain)]

    head = ["", *(f"{what}|{title}" for title in (*GAUGES.values(), "own best factor") for what in ("RMSE", "null"))]
    rows = [[title, *cells(view)] for view, title in VIEWS.items() if view in mean["none"]]
    return Table("light", "Light: three spheres and the map itself", [*head, "angle|RGB", "null|RGB"], rows)
