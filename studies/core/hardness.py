"""What becomes of a hard case: the benchmarks' own measurements, as scores.

operator   `benchmarks.operator`: error of the network's values against quadrature, and rounding of its derivatives in float32
solve      `tests.scenes.hard_cases`: errors of reflectance, of roughness and of re-synthesis, and the largest of these over its bound,
           which the tests of the solve have too; whether the solve says what cannot be determined is tested there
align      `benchmarks.align`: of a photo of each shape, the share of wrong poses and the median error of normals, where a pose can be
           right; and the share of poses that are wrong, or cannot be right, without any doubt
"""

from __future__ import annotations

import numpy as np

from studies.core.case import Score
from studies.core.hard import Hard


def score_of(case: Hard) -> Score:
    """By the table that the case is of."""
    values = {"operator": operator, "solve": solve, "align": align}[case.table](case)
    return Score({measure: float(value) for measure, value in values.items()})


def operator(case: Hard) -> dict[str, float]:
    """Of the network in float32."""
    from benchmarks.operator import made, measures
    from tests.scenes.operators import case as pairs_of

    float32, float64 = ({f"network {d}": made("network", d)} for d in ("float32", "float64"))
    found = measures(pairs_of(case.case), float32 | float64)["network float32"]
    return {
        "value_error": found["value"],
        "gradient_rounding": found["gradient_rounding"],
        "not_finite": not found["finite"],
    }


def solve(case: Hard) -> dict[str, float]:
    """With the noise of the seed."""
    from tests.scenes.hard_cases import BOUNDS, CASES, answered

    answer, bound = answered(CASES[case.case](case.seed)), BOUNDS[case.case]
    errors = {error: getattr(answer, error) for error in ("k", "roughness", "radiance")}
    bounded = {error: value for error, value in errors.items() if getattr(bound, error) is not None}
    shares = [value / getattr(bound, error) for error, value in bounded.items()]
    return {f"hard_{error}": value for error, value in bounded.items() if np.isfinite(value)} | {
        "of_bound": max(shares)
    }


def align(case: Hard) -> dict[str, float]:
    """Of a photo of each shape."""
    from benchmarks.align import RIGHT, measured
    from tests.scenes.shapes import SHAPES

    rows = [measured((case.case, shape, case.seed, 0)) for shape in list(SHAPES)[: case.shapes]]
    can_be_right = case.case in RIGHT
    wrong = [row for row in rows if not (can_be_right and row["right"])]
    found = {"undoubted": np.mean([float(row in wrong and not row["doubts"]) for row in rows])}
    if can_be_right:
        found |= {
            "wrong_poses": len(wrong) / len(rows),
            "normal_error": np.median([row["normal_error_deg"] for row in rows]),
        }
    return found
