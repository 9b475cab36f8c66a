"""Time, error and stability of every reflection operator: `make results ONLY=operator`.

Error      of values |R − S| / (S + E/100), of gradients |∂R − ∂S| / (|∂S| + S + E/100); S by quadrature, E the lobe's
           integral
Time       of one evaluation, that is, one observation and one lobe, diffuse and specular: processor time of one thread,
           the operators in turn within each repeat, so that whatever else the machine does falls on all of them; the
           least and the median of the repeats. Ratios between operators hold; absolute times are the machine's.
"""

import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import normalize

from factorlib.reflection import Operator
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.operator import NAMES
from factorlib.reflection.reference import Reference
from factorlib.reflection.samples import (
    QUANTILES,
    DiffuseSamples,
    Samples,
    diffuse_samples,
    diffuse_table,
    quantiles,
    specular_inputs,
    specular_samples,
    specular_table,
)
from factorlib.scenes import operator_cases as laws
from studies.measured.tools import Tables, exact

REFERENCE = "reference"
FAST = [name for name in NAMES if name != "reference"]
TOLERANCES = {"reference 10⁻²": 1e-2, "reference 10⁻⁴": 1e-4, REFERENCE: 1e-7}
SLOPES = {"roughness": "roughness", "log_sharpness": "log λ", "no": "n·o", "nz": "n·z", "oz": "o·z"}
INPUTS = ("roughness", "sharpness", "cosine of the view", "degrees from the mirror direction")
SAMPLES = 16384
GRADIENTS = 512
LOBES = 64
REPEATS = 7

# ── The operators as they can be run ─────────────────────────────────────────────────────────────────────────────────


def variants() -> dict[str, Operator]:
    """Return fast operators by label, e.g. "network float32".

    "network float32 torch" is its torch path where C is there too.
    """
    operators: dict[str, Operator | None] = {}
    for name in FAST:
        operators |= {f"{name} {dtype}": laws.operator_variant(name, dtype) for dtype in ("float32", "float64")}
        if any(getattr(operators[f"{name} float32"], "fused", {}).values()):
            operators[f"{name} float32 torch"] = laws.operator_variant(name, "float32", compiled=False)
    return {label: operator for label, operator in operators.items() if operator is not None}


def label_of(label: str) -> str:
    """Return the label as tables have it."""
    return label.replace("_", " ").replace("float", "f")


# ── Errors ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def specular_errors(operator: Operator, samples: Samples) -> dict:
    """Return quantiles of the error over all samples, and by several inputs.

    These are roughness, sharpness, cosine of the view and angle from the mirror direction.
    """
    a, lam, no, nz, oz = (t.to(operator.dtype) for t in samples.inputs())
    with torch.no_grad():
        value = operator.specular(a.sqrt()[:, None], lam[:, None], no, nz[:, None], oz[:, None])[:, 0].double()
    error = (value - samples.value) / samples.scale()
    return _of_finite(lambda some: specular_table(error[some], *(t[some] for t in samples.inputs())), value)


def diffuse_errors(operator: Operator, samples: DiffuseSamples) -> dict:
    """Return quantiles of the error over all samples, and by sharpness and the lobe's angle from the normal."""
    sharpness, nz = (t[:, None].to(operator.dtype) for t in (samples.sharpness, samples.nz))
    with torch.no_grad():
        value = operator.diffuse(sharpness, nz)[:, 0].double()
    error = (value - samples.value) / samples.scale()
    return _of_finite(lambda some: diffuse_table(error[some], samples.sharpness[some], samples.nz[some]), value)


def _of_finite(table: Callable[[Tensor], dict], value: Tensor) -> dict:
    """Return the table of the samples whose value is finite, and how many are not, if any."""
    some = value.isfinite()
    return (table(some) if some.any() else {}) | ({} if some.all() else {"not finite": int((~some).sum())})


def gradient_errors(operator: Operator, true: list[Tensor]) -> dict:
    """Return quantiles of the error by input; true: `gradients` of the reference."""
    scale = true[0] + lobe_integral(specular_inputs(GRADIENTS, 5)[1]) / 100
    pairs = zip(SLOPES, gradients(operator)[1:], true[1:], strict=True)
    errors = {name: (a - b) / (b.abs() + scale) for name, a, b in pairs}
    return {name: _of_finite(lambda some, e=e: quantiles(e[some]), e) for name, e in errors.items()}


def gradients(operator: Operator) -> list[Tensor]:
    """Compute value and derivatives of samples that share nothing, float64; each is one lobe and one point."""
    alpha, sharpness, no, nz, oz = specular_inputs(GRADIENTS, 5)
    inputs = (alpha.sqrt(), sharpness.log(), no, nz, oz)
    leaves = [t.to(operator.dtype)[:, None].clone().requires_grad_() for t in inputs]
    value = operator.specular(leaves[0], leaves[1].exp(), *leaves[2:])
    return [t.detach()[:, 0].double() for t in (value, *torch.autograd.grad(value.sum(), leaves))]


# ── Time ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def point(operator: Operator, count: int) -> tuple[Tensor, ...]:
    """Draw roughness, λ, n·o, n·z, o·z of random points under `LOBES` lobes of sharpness .3 to 3000."""
    g = torch.Generator().manual_seed(0)
    n, o, z = (normalize(torch.randn(k, 3, generator=g, dtype=torch.float64), dim=1) for k in (count, count, LOBES))
    o = torch.where(((n * o).sum(1) > 0)[:, None], o, -o)
    inputs = (torch.tensor(0.4), torch.logspace(-0.5, 3.5, LOBES), (n * o).sum(1), n @ z.T, o @ z.T)
    return tuple(t.to(operator.dtype) for t in inputs)


def values(operator: Operator, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> None:
    """Compute values alone."""
    with torch.no_grad():
        operator.diffuse(sharpness, nz)
        operator.specular(roughness, sharpness, no, nz, oz)


def gradient(operator: Operator, *inputs: Tensor) -> None:
    """Compute values and all derivatives."""
    operator.response(*inputs)


def microseconds(
    operators: dict[str, Operator], rows: int = 1024, repeats: int = REPEATS
) -> dict[str, list[list[float]]]:
    """Time all repeats, of values alone and of values with all derivatives, by operator."""
    counts = {label: 8 if label in TOLERANCES else rows for label in operators}
    inputs = {label: point(operator, counts[label]) for label, operator in operators.items()}
    taken: dict[str, list[list[float]]] = {label: [[], []] for label in operators}
    for _ in range(repeats + 1):
        for label, operator in operators.items():
            for of, measure in zip(taken[label], (values, gradient), strict=True):
                start = time.process_time()
                measure(operator, *inputs[label])
                of.append((time.process_time() - start) / (counts[label] * LOBES) * 1e6)
    return {label: [of[1:] for of in pair] for label, pair in taken.items()}  # the first one compiles


# ── Special cases and laws ───────────────────────────────────────────────────────────────────────────────────────────


def measures(given: laws.Pairs, fast: dict[str, Operator], with_reference: bool = True) -> dict[str, dict[str, float]]:
    """Return the worst errors of every operator in float32 of `fast`.

    They are of values against the reference, and by rounding against its float64.
    """
    exactly = {label.split()[0]: laws.answers(o, given) for label, o in fast.items() if label.endswith("float64")}
    true = laws.reference_values(given) if with_reference else None
    table = {}
    for label, operator in fast.items():
        if "float64" not in label:
            answer = laws.answers(operator, given)
            wide = exactly[label.split()[0]]
            kinds = {"value": laws.value_error, "gradient": laws.gradient_error}
            errors = {f"{kind}_rounding": error(answer, wide, given) for kind, error in kinds.items()}
            if true:
                errors["value"] = laws.value_error(answer, laws.Answers(true, answer.turning), given)
            table[label] = {name: float(error.max()) for name, error in errors.items()} | {"finite": answer.finite()}
    return table


LAWS: dict[str, Callable[[Operator], tuple[float, ...]]] = {
    "reflection of a unit lobe, at most 1: roughness ≥ .1, n·o ≥ .02": lambda o: laws.reflection_of_unit_lobes(
        o, laws.USUAL
    ),
    "… roughness ≥ .1, n·o ≥ 10⁻⁴": lambda o: laws.reflection_of_unit_lobes(o, laws.WIDER),
    "… roughness ≥ .03, n·o ≥ 10⁻⁴": lambda o: laws.reflection_of_unit_lobes(o, laws.WHOLE),
    "least of it, at least 0": laws.least_reflection,
    "GGX of k_s = 1 under constant light, at most 1": laws.reflection_of_constant_light,
    "white Lambert under constant light, distance from 1": laws.white_lambert_error,
    "point light (λ = 10⁶), distance from the BRDF": laws.point_light_error,
    "everything turned: change over the largest radiance": laws.rotation_error,
    "weights times 10⁶: relative change of radiance / 10⁶": laws.scaling_error,
}


def special(fast: dict[str, Operator]) -> Tables:
    """Return rounding and errors of values in special cases, and how far each operator breaks the laws."""
    single = {label_of(label).replace(" f32", ""): o for label, o in fast.items() if "float64" not in label}
    cases = {name: list(measures(laws.case(name), fast, name != laws.ALL).values()) for name in (*laws.CASES, laws.ALL)}
    broken = [
        [law, *(" / ".join(exact(v, 4 if v > 0.1 else 2) for v in measure(o)) for o in single.values())]
        for law, measure in LAWS.items()
    ]
    return {
        "Worst error of float32 against float64 in the same operator: of values / of derivatives": [
            ["changed", *single],
            *(
                [name, *(f"{exact(e['value_rounding'])} / {exact(e['gradient_rounding'])}" for e in row)]
                for name, row in cases.items()
            ),
        ],
        "Worst error of values against the reference": [
            ["changed", *single],
            *([name, *(exact(e["value"]) for e in row)] for name, row in cases.items() if name != laws.ALL),
        ],
        "Laws: 99th percentile / worst, or the worst alone": [["law", *single], *broken],
    }


# ── Tables ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def rows() -> Tables:
    """Return tables of all operators: time, errors of values and derivatives, and of values by what is asked."""
    fast = variants()
    references = {label: Reference(tolerance=tolerance) for label, tolerance in TOLERANCES.items()}
    times = microseconds(fast | references)
    specular = specular_samples(SAMPLES, 99, tolerance=1e-7)
    diffuse = diffuse_samples(SAMPLES, 98)
    glossy = {label: specular_errors(o, specular) for label, o in (fast | references).items() if label != REFERENCE}
    matte = {label: diffuse_errors(operator, diffuse) for label, operator in fast.items()}
    true = gradients(references[REFERENCE])
    single = [label for label in fast if label.endswith("float32")]
    fastest = min(statistics.median(pair[1]) for pair in times.values())
    costs = []
    slopes = []
    by_input = []
    for label, pair in times.items():
        cells = [f"{exact(min(of))}, {exact(statistics.median(of))}" for of in pair]
        costs.append([label_of(label), *cells, f"{exact(statistics.median(pair[1]) / fastest)} ×"])
    for label in single:
        errors = gradient_errors(fast[label], true)
        slopes += [[f"{label_of(label)}, by {word}", *_percents(errors[slope])] for slope, word in SLOPES.items()]
    for quantity, part in ((q, part) for q in INPUTS for part in glossy[single[0]][q]):
        asked = (glossy[label][quantity][part] for label in single)
        by_input.append([f"{quantity} {part}", *(f"{_percent(e, 'median')}, {_percent(e, 'p95')}" for e in asked)])
    whole = [
        [f"{label_of(k)}, {kind}", *_percents(e)]
        for kind, of in (("specular", glossy), ("diffuse", matte))
        for k, e in of.items()
    ]
    return {
        "µs per evaluation: least, median": [["operator", "values", "values and gradients", "of the fastest"], *costs],
        "Errors of values": [["operator", *QUANTILES], *whole],
        "Errors of derivatives": [["operator", *QUANTILES], *slopes],
        "Specular errors by what is asked: median, p95": [["asked", *map(label_of, single)], *by_input],
    } | special(fast)


def _percents(errors: dict) -> list[str]:
    return [_percent(errors, quantile) for quantile in QUANTILES]


def _percent(errors: dict, quantile: str) -> str:
    return f"{exact(100 * errors[quantile])} %" if quantile in errors else "–"
