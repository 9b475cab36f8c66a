"""Hard cases: what becomes of the operator, the solve and alignment where each is hardest?

Varied     the cases of docs/operator.md, docs/solve.md and docs/align.md; seeds are of noise and of poses, the operator's cases have none.
Measured   by the measurements of `studies.measured`; the worst are named below the figure:
           operator   error of the network's values against quadrature, and rounding of its derivatives in float32
           solve      errors of reflectance, of roughness and of re-synthesis, and the largest of these over its bound in the tests
           align      of a photo of each shape, the share of wrong poses and the median error of normals, where a pose can be
                      right; and the share of poses that are wrong, or cannot be right, without any doubt
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.steps import Params
from studies.study import Scale, Score, Setting, Study

CASES = {  # as those modules call them, which a test compares: a plan must not import them
    "operator": (
        "none: ordinary", "lobe behind the surface", "lobe on the horizon", "view at n·o = 10⁻⁴", "view along n", "roughness .03", "roughness 1",
        "sharpness 10⁻⁴", "sharpness 10⁶", "lobe along n", "lobe along −n", "lobe along the mirror direction", "lobe along o", "lobe along −o",
    ),
    "solve": (
        "ordinary: 2 materials × 2 lights", "1 material × 1 light", "1 material × 5 lights", "5 materials × 1 light",
        "unconnected: 2 × 1 and 3 × 1", "flat objects", "an object of 30 pixels", "a single pixel", "all Lambertian",
        "all mirror-like: roughness .1", "a black material", "a light of one point", "constant light", "radiances × 10⁻⁴", "radiances × 10⁴",
        "sun 10⁴ × the sky", "half the values clipped", "all values clipped", "20 % of normals wrong by 40°", "normals with noise of 1°",
        "normals with noise of 2°", "normals with noise of 5°", "normals with noise of 10°", "two equal materials",
        "a material without pixels", "NaN, infinite, no direction",
    ),
    "align": ("exact", "rough", "wrong mesh", "wrong mask", "mirrored mask", "tiny mask"),
}  # fmt: skip
QUICK = {"operator": CASES["operator"][:4], "solve": CASES["solve"][:1] + CASES["solve"][16:17], "align": ("exact",)}
WORST = 3  # cases of a measure that are named


def settings(scale: Scale) -> list[Setting]:
    """Table by table; a quick study aligns one shape."""
    shapes = 1 if scale.quick else 99
    rows = [(table, name) for table, names in (QUICK if scale.quick else CASES).items() for name in names]
    cases = {row: {"table": row[0], "name": row[1], "shapes": shapes} for row in rows}
    return [
        Setting(f"{t}-{CASES[t].index(n)}", f"{t}: {n}", lambda seed, c=c: {"seed": seed, **c})
        for (t, n), c in cases.items()
    ]


def worst(table: Any) -> list[str]:
    """Of each measure, the cases whose worst seed is worst, as a sentence."""
    from studies.conclusion import label as label_of

    sentences = []
    for m in table.measures:
        values = {row.label: max(row.cells[m].values.values()) for row in table.rows if m in row.cells}
        ranked = sorted(values, key=values.get, reverse=True)[:WORST]
        cases = "; ".join(f"{label.partition(': ')[2]} {values[label]:.3g}" for label in ranked)
        sentences += [f"{label_of(m)}, worst of all seeds: {cases}."] if cases else []
    return sentences


STUDY = Study(
    name="hard-cases",
    title="Hard cases",
    question="What becomes of the operator, the solve and alignment where each is hardest?",
    paper="Nothing.",
    varied="case",
    measures=(
        "of_bound", "value_error", "wrong_poses", "undoubted", "hard_k", "hard_roughness", "hard_radiance", "gradient_rounding", "normal_error",
    ),
    settings=settings,
    steps=(),
    notes=worst,
)  # fmt: skip


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Measure a case: writes <case>.json."""
    case = inputs.facts["dataset.case"]
    values = {"operator": operator, "solve": solve, "align": align}[case["table"]](case)
    write_json(out / f"{inputs.photo}.json", Score({measure: float(value) for measure, value in values.items()}))


def operator(case: dict[str, Any]) -> dict[str, float]:
    """The network in float32."""
    from studies.measured.operator import made, measures
    from studies.scenes.operators import case as pairs_of

    float32, float64 = ({f"network {d}": made("network", d)} for d in ("float32", "float64"))
    of = measures(pairs_of(case["name"]), float32 | float64)["network float32"]
    return {"value_error": of["value"], "gradient_rounding": of["gradient_rounding"], "not_finite": not of["finite"]}


def solve(case: dict[str, Any]) -> dict[str, float]:
    """With the noise of the seed."""
    import math

    from studies.scenes.hard_cases import BOUNDS, CASES, answered

    answer, bound = answered(CASES[case["name"]](case["seed"])), BOUNDS[case["name"]]
    bounds = {e: b for e in ("k", "roughness", "radiance") if (b := getattr(bound, e)) is not None}
    errors = {e: getattr(answer, e) for e in bounds}
    finite = {f"hard_{e}": value for e, value in errors.items() if math.isfinite(value)}
    return finite | {"of_bound": max(errors[e] / bounds[e] for e in bounds)}


def align(case: dict[str, Any]) -> dict[str, float]:
    """A photo of each shape."""
    from statistics import median

    from studies.measured.align import RIGHT, measured
    from studies.scenes.shapes import SHAPES

    rows = [measured((case["name"], shape, case["seed"], 0)) for shape in list(SHAPES)[: case["shapes"]]]
    can_be_right = case["name"] in RIGHT
    wrong = [row for row in rows if not (can_be_right and row["right"])]
    values = {"undoubted": sum(not row["doubts"] for row in wrong) / len(rows)}
    if can_be_right:
        errors = median(row["normal_error_deg"] for row in rows)
        values |= {"wrong_poses": len(wrong) / len(rows), "normal_error": errors}
    return values
