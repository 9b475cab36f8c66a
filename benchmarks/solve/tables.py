"""The tables of docs/solve-speed.md, of solve.json's content."""

from __future__ import annotations

from benchmarks.markdown import table
from benchmarks.rounded import exact

LEVELS = (42, 45)  # dB


def as_tables(result: dict) -> dict[str, str]:
    return {"ends": ends(result["sets"]), "levels": levels(result["sets"]), "scaling": scaling(result.get("scaling"))}


def ends(sets: dict) -> str:
    """What each run ended with, on all pixels."""
    rows = []
    for name, one in sets.items():
        for label, row in one["solvers"].items():
            psnr, materials, last = row["resynthesis"]["psnr"], row["materials"], row["points"][-1]
            relit = row.get("relighting")
            rows.append([
                name, _named(label, row), f"{last['wall']:.0f}", f"{last['processor']:.0f}", f"{psnr['mean']:.1f}, {psnr['worst']:.1f}",
                *(f"{materials[k]['mean']:.1%}, {materials[k]['worst']:.1%}" for k in ("diffuse", "specular")),
                f"{exact(materials['roughness']['mean'])}, {exact(materials['roughness']['worst'])}",
                f"{relit['psnr']['mean']:.1f}, {relit['psnr']['worst']:.1f}" if relit else "",
            ])  # fmt: skip
    columns = ["set", "solver", "wall, s", "processor, s", "dB: mean, worst", "k_d: mean, worst", "k_s: mean, worst", "roughness: mean, worst"]
    return table([*columns, "unseen pairs, dB: mean, worst"], rows)


def levels(sets: dict) -> str:
    """When each run first stood at so many dB, mean over pairs."""
    rows = []
    for name, one in sets.items():
        for label, row in one["solvers"].items():
            rows.append([name, _named(label, row), *(_first(row["points"], level) for level in LEVELS)])
    return table(["set", "solver", *(f"{level} dB: wall, processor, s" for level in LEVELS)], rows)


def _named(label: str, row: dict) -> str:
    """With the share of the observations that the run was given, where it was not all."""
    return label if row.get("share", 1) == 1 else f"{label}, on {row['share']:.0%}"


def _first(points: list[dict], level: float) -> str:
    reached = next((p for p in points if p["mean_db"] >= level), None)
    return f"{reached['wall']:.0f}, {reached['processor']:.0f}" if reached else "not reached"


def scaling(found: dict | None) -> str:
    if found is None:
        return "Not run."
    rows = [[entries, f"{t['wall']:.1f}", f"{t['processor']:.1f}"] for entries, t in sorted(found["entries"].items(), key=lambda item: int(item[0]))]
    said = ", ".join(f"{value:.2f} ({kind})" for kind, value in found["exponent"].items())
    return table(["filled entries", "wall, s", "processor, s"], rows) + f"\n\nExponent: {said}."
