"""Time and error of every reflection operator: `make results ONLY=operator`.

Tables and the seconds of the measurement are written to docs/results.md.

Error      of values |R − S| / (S + E/100), of gradients |∂R − ∂S| / (|∂S| + S + E/100); S by quadrature, E the lobe's
           integral
Time       of one evaluation, that is, one observation and one lobe, diffuse and specular: processor time of one thread,
           the operators in turn within each repeat, so that other work of the machine delays all of them alike; the
           least and the median of the repeats. Ratios between operators hold; absolute times are the machine's.

Special cases and laws are tested: tests/reflection.
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
from factorlib.scenes.operator_variant import operator_variant
from studies.measured.tools import Tables, format_number, format_numbers

REFERENCE = "reference"
FAST = [name for name in NAMES if name != "reference"]
TOLERANCES = {"reference 10⁻²": 1e-2, "reference 10⁻⁴": 1e-4, REFERENCE: 1e-7}
SLOPES = {"roughness": "roughness", "log_sharpness": "log λ", "no": "n·o", "nz": "n·z", "oz": "o·z"}
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
        operators |= {f"{name} {dtype}": operator_variant(name, dtype) for dtype in ("float32", "float64")}
        if any(getattr(operators[f"{name} float32"], "fused", {}).values()):
            operators[f"{name} float32 torch"] = operator_variant(name, "float32", compiled=False)
    return {label: operator for label, operator in operators.items() if operator is not None}


def label_of(label: str) -> str:
    """Format the label of an operator for tables."""
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
    return _finite_only(lambda rows: specular_table(error[rows], *(t[rows] for t in samples.inputs())), value)


def diffuse_errors(operator: Operator, samples: DiffuseSamples) -> dict:
    """Return quantiles of the error over all samples, and by sharpness and the lobe's angle from the normal."""
    sharpness, nz = (t[:, None].to(operator.dtype) for t in (samples.sharpness, samples.nz))
    with torch.no_grad():
        value = operator.diffuse(sharpness, nz)[:, 0].double()
    error = (value - samples.value) / samples.scale()
    return _finite_only(lambda rows: diffuse_table(error[rows], samples.sharpness[rows], samples.nz[rows]), value)


def _finite_only(table: Callable[[Tensor], dict], value: Tensor) -> dict:
    """Return the table of the samples whose value is finite, and how many are not, if any."""
    finite = value.isfinite()
    return (table(finite) if finite.any() else {}) | ({} if finite.all() else {"not finite": int((~finite).sum())})


def gradient_errors(operator: Operator, true: list[Tensor]) -> dict:
    """Return quantiles of the error by input; true: `gradients` of the reference."""
    scale = true[0] + lobe_integral(specular_inputs(GRADIENTS, 5)[1]) / 100
    pairs = zip(SLOPES, gradients(operator)[1:], true[1:], strict=True)
    errors = {name: (a - b) / (b.abs() + scale) for name, a, b in pairs}
    return {name: _finite_only(lambda rows, e=e: quantiles(e[rows]), e) for name, e in errors.items()}


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


def evaluate(operator: Operator, inputs: tuple[Tensor, ...], derivatives: bool) -> None:
    """Compute values alone, or values and all derivatives."""
    if derivatives:
        operator.response(*inputs)
        return
    with torch.no_grad():
        operator.diffuse(inputs[1], inputs[3])
        operator.specular(*inputs)


def microseconds(operators: dict[str, Operator]) -> dict[str, list[list[float]]]:
    """Time all repeats, of values alone and of values with all derivatives, by operator."""
    counts = {label: 8 if label in TOLERANCES else 1024 for label in operators}
    inputs = {label: point(operator, counts[label]) for label, operator in operators.items()}
    times: dict[str, list[list[float]]] = {label: [[], []] for label in operators}
    for _ in range(REPEATS + 1):
        for label, operator in operators.items():
            for derivatives in (False, True):
                start_s = time.process_time()
                evaluate(operator, inputs[label], derivatives)
                seconds = time.process_time() - start_s
                times[label][derivatives].append(seconds / (counts[label] * LOBES) * 1e6)
    return {label: [repeats[1:] for repeats in pair] for label, pair in times.items()}  # the first one compiles


# ── Tables ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def rows() -> Tables:
    """Return tables of all operators: time, errors of values and of derivatives."""
    fast = variants()
    references = {label: Reference(tolerance=tolerance) for label, tolerance in TOLERANCES.items()}
    times = microseconds(fast | references)
    specular = specular_samples(SAMPLES, 99, tolerance=1e-7)
    diffuse = diffuse_samples(SAMPLES, 98)
    true = gradients(references[REFERENCE])
    glossy = {label: specular_errors(o, specular) for label, o in (fast | references).items() if label != REFERENCE}
    matte = {label: diffuse_errors(operator, diffuse) for label, operator in fast.items()}
    slopes = {label: gradient_errors(fast[label], true) for label in fast if label.endswith("float32")}
    fastest = min(statistics.median(pair[1]) for pair in times.values())
    costs = [
        [
            label_of(label),
            *(format_numbers([min(repeats), statistics.median(repeats)]) for repeats in pair),
            f"{format_number(statistics.median(pair[1]) / fastest)} ×",
        ]
        for label, pair in times.items()
    ]
    values = {f"{label_of(label)}, specular": errors for label, errors in glossy.items()}
    values |= {f"{label_of(label)}, diffuse": errors for label, errors in matte.items()}
    derivatives = {
        f"{label_of(label)}, by {SLOPES[slope]}": quantile
        for label, errors in slopes.items()
        for slope, quantile in errors.items()
    }
    return {
        "µs per evaluation: least, median": [["operator", "values", "values and gradients", "of the fastest"], *costs],
        "Errors of values": _percents("error", values),
        "Errors of derivatives": _percents("error of the derivative", derivatives),
    }


def _percents(title: str, errors: dict[str, dict]) -> list[list[str]]:
    cells = {
        name: [f"{format_number(100 * row[q])} %" if q in row else "–" for q in QUANTILES]
        for name, row in errors.items()
    }
    return [[title, *QUANTILES], *([name, *values] for name, values in cells.items())]
