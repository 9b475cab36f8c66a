"""The tables of errors against truth, each number beside what a null scores."""

from __future__ import annotations

import msgspec

from factorlib.report.text import number, percent

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
    "matte": "matte sphere",
    "map_all": "map, all directions",
    "map_mirrored": "map, where a pixel mirrors it",
    "map_unmirrored": "map, elsewhere",
}


class Table(msgspec.Struct, frozen=True):
    """head: column titles; rows: cells as text, the first one a row title; nulls: rows that are nulls, by index."""

    key: str
    title: str
    caption: str
    head: list[str]
    rows: list[list[str]]
    nulls: list[int] = []


def error_tables(metrics: dict, photos: list[str], materials: list[str]) -> list[Table]:
    """Of what the metrics have, in the set's order of photos and materials; re-synthesis always."""
    made = [_resynthesis(metrics["resynthesis"], photos), _materials(metrics["materials"], materials), _relighting(metrics["relighting"]),
            _unobserved(metrics["relighting"]), _light(metrics["light"]), _normals(metrics["normals"], photos), _poses(metrics["poses"], photos)]  # fmt: skip
    return [table for table in made if table]


def _ordered(found: dict, order: list[str]) -> list[tuple[str, dict]]:
    return [(name, found[name]) for name in order if name in found]


def _picture(error: dict) -> list[str]:
    return [number(error["psnr_linear_db"], 1), number(error["psnr_tonemapped_db"], 1), number(error["dssim"], 4)]


def _by_gauge(rows: list[tuple[str, dict]]) -> list[list[str]]:
    return [[name, *(cell for g in GAUGES for cell in _picture(by_gauge[g]))] for name, by_gauge in rows]


PICTURE_HEAD = ["", *(f"{what}|{title}" for title in GAUGES.values() for what in ("PSNR lin., dB", "PSNR, dB", "DSSIM"))]


def _resynthesis(found: dict, order: list[str]) -> Table | None:
    if not found["mean"]:
        return None
    photos = {n: p["gauges"] for n, p in _ordered(found["photos"], order) if p["gauges"]}
    rows = [(n, {g: s["estimate"] for g, s in by.items()}) for n, by in photos.items()]
    rows.append(("mean", {g: s["estimate"] for g, s in found["mean"].items()}))
    rows.append(("null: flat colours, mean", {g: s["null"] for g, s in found["mean"].items()}))
    return Table("resynthesis", "Re-synthesis against the photos",
                 "Over the pixels that count: mask and mesh agree, not clipped. The null paints each material of each photo in its own mean colour.",
                 PICTURE_HEAD, _by_gauge(rows), [len(rows) - 1])  # fmt: skip


def _materials(found: dict | None, order: list[str]) -> Table | None:
    if not found:
        return None
    rows = []
    for name, m in _ordered(found["materials"], order):
        e, z = m["error"], m["null"]
        rows.append([name, number(m["truth"]["roughness"], 3), number(m["estimate"]["roughness"], 3), number(e["roughness"], 3),
                     number(z["roughness"], 3), _worst(e["diffuse"]), _worst(z["diffuse"]), _worst(e["specular"]), _worst(z["specular"])])  # fmt: skip
    rows.append(["mean", "", "", number(found["mean_roughness"], 3), number(found["null_mean_roughness"], 3), percent(found["mean_diffuse"]),
                 percent(found["null_mean_diffuse"]), percent(found["mean_specular"]), percent(found["null_mean_specular"])])  # fmt: skip
    head = ["", "true|roughness", "found|roughness", "error|roughness", "null|roughness", "error|diffuse", "null|diffuse", "error|specular", "null|specular"]
    return Table("materials", "Materials against the truth",
                 "Roughness: absolute. Colours: the worst channel's relative error, after the one factor per channel that all linked materials "
                 "share. The null is a grey ball (diffuse 0.5, specular 0.05, roughness 0.5) with its own factor. The mean is over channels.",
                 head, rows)  # fmt: skip


def _worst(errors: list[float]) -> str:
    return percent(max(errors, key=abs))


def _kinds(key: str, title: str, caption: str, mean: dict) -> Table:
    rows = [(title_, {g: mean[g][kind] for g in GAUGES}) for kind, title_ in KINDS.items()]
    return Table(key, title, caption, PICTURE_HEAD, _by_gauge(rows), [2, 3])


def _relighting(found: dict | None) -> Table | None:
    if not found:
        return None
    return _kinds("relighting", "Relighting, all pairs of material and light",
                  "Balls against balls of the true material in the true light, mean over balls. A factor per channel and picture flatters "
                  "everything, the grey ball too: read a number only against its null.", found["mean"])  # fmt: skip


def _unobserved(found: dict | None) -> Table | None:
    if not found or not found["mean_unobserved"]:
        return None
    return _kinds("unobserved", "Relighting, only pairs that no photo shows",
                  "The same over the pairs that were never seen together: what the joint solve predicts.", found["mean_unobserved"])  # fmt: skip


def _light(found: dict | None) -> Table | None:
    if not found:
        return None
    head = ["", *(f"{what}|{title}" for title in GAUGES.values() for what in ("RMSE", "null")), "RMSE|own best factor", "null|own best factor",
            "angle|RGB", "null|RGB"]  # fmt: skip
    rows = []
    for view, title in VIEWS.items():
        if view in found["mean"]["none"]:
            scored = {g: found["mean"][g][view] for g in GAUGES}
            cells = [number(scored[g][k]["rmse"], 3) for g in GAUGES for k in ("estimate", "null")]
            plain = scored["none"]
            cells += [number(plain[k]["rmse_scale_invariant"], 3) for k in ("estimate", "null")]
            rows.append([title, *cells, *(number(plain[k]["rgb_angle_deg"], 1) + "°" for k in ("estimate", "null"))])
    return Table("light", "Light: three spheres and the map itself",
                 "White spheres lit by the recovered and by the true light. RMSE as a fraction of the truth's root mean square (black scores 1). "
                 "The null is a constant light of the true mean colour. Mirrored: directions that some pixel reflects into the camera.",
                 head, rows)  # fmt: skip


def _normals(found: dict | None, order: list[str]) -> Table | None:
    if not found:
        return None
    rows = [[n, *(number(e[k][q], 2) + "°" for q in ("median_deg", "p90_deg") for k in ("estimate", "null"))] for n, e in _ordered(found, order)]
    head = ["", "found|median", "null|median", "found|90th percentile", "null|90th percentile"]
    return Table("normals", "Normals against the truth", "Angle over the observed pixels. The null faces the camera everywhere.", head, rows)


def _poses(found: dict | None, order: list[str]) -> Table | None:
    if not found:
        return None
    rows = [[f"{p} · {o}", number(e["rotation_deg"], 2) + "°", number(e["null_rotation_deg"], 1) + "°", percent(e["translation_relative"], 2)]
            for p, objects in _ordered(found, order) for o, e in objects.items()]  # fmt: skip
    return Table("poses", "Poses against the truth",
                 "A symmetric shape can be far off in rotation and right in every pixel: see the normals. Null: a random rotation, on average.",
                 ["", "rotation", "null", "translation / distance"], rows)  # fmt: skip
