"""Time per evaluation, that is, per observation and lobe: diffuse and specular values alone, and with all gradients (`response`).

Processor time of one thread, the operators in turn within each repeat, so that whatever else the machine does falls on all
of them; the least and the median of the repeats.  Ratios between operators hold; absolute times are the machine's.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from factorlib.reflection import Operator

LOBES = 64
REPEATS = 7


def point(operator: Operator, rows: int, device: str = "cpu") -> tuple[Tensor, ...]:
    """Roughness, λ, n·o, n·z, o·z of random points under 64 lobes of sharpness .3 to 3000."""
    g = torch.Generator().manual_seed(0)
    n, o, z = (
        torch.nn.functional.normalize(torch.randn(k, 3, generator=g, dtype=torch.float64), dim=1)
        for k in (rows, rows, LOBES)
    )
    o = torch.where(((n * o).sum(1) > 0)[:, None], o, -o)
    inputs = (torch.tensor(0.4), torch.logspace(-0.5, 3.5, LOBES), (n * o).sum(1), n @ z.T, o @ z.T)
    return tuple(t.to(device, operator.dtype) for t in inputs)


def values(operator: Operator, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> None:
    with torch.no_grad():
        operator.diffuse(sharpness, nz)
        operator.specular(roughness, sharpness, no, nz, oz)


def values_and_gradients(operator: Operator, *inputs: Tensor) -> None:
    operator.response(*inputs)


MEASURES = {"values": values, "values_and_gradients": values_and_gradients}


def microseconds(operators: dict[str, Operator], rows: Callable[[str], int]) -> dict[str, dict]:
    """{operator: {measure: {"least", "median"}}}; `rows` says how many points an operator is timed on."""
    inputs = {label: point(operator, rows(label)) for label, operator in operators.items()}
    taken: dict[tuple[str, str], list[float]] = {}
    for repeat in range(REPEATS + 1):  # the first one compiles
        for label, operator in operators.items():
            for name, measure in MEASURES.items():
                start = time.process_time()
                measure(operator, *inputs[label])
                if repeat:
                    taken.setdefault((label, name), []).append(
                        (time.process_time() - start) / (rows(label) * LOBES) * 1e6
                    )
    return {label: {name: _summary(taken[label, name]) for name in MEASURES} for label in operators}


def _summary(times: list[float]) -> dict[str, float]:
    return {"least": float(f"{min(times):.3g}"), "median": float(f"{statistics.median(times):.3g}")}


def cuda_rates(operators: dict[str, Operator], rows: int = 1 << 15) -> dict[str, dict]:
    """Millions of evaluations per second on the first CUDA device, after a warm-up; empty without one."""
    if not torch.cuda.is_available():
        return {}
    found: dict[str, dict] = {"device": {"name": torch.cuda.get_device_name(0)}}
    for label, operator in operators.items():
        move(operator, "cuda")
        inputs = point(operator, rows, "cuda")
        found[label] = {name: _rate(measure, operator, inputs, rows) for name, measure in MEASURES.items()}
        move(operator, "cpu")
    return found


def _rate(measure: Callable, operator: Operator, inputs: tuple[Tensor, ...], rows: int) -> float:
    taken = []
    for _ in range(REPEATS + 2):
        torch.cuda.synchronize()
        start = time.perf_counter()
        measure(operator, *inputs)
        torch.cuda.synchronize()
        taken.append(time.perf_counter() - start)
    return float(f"{rows * LOBES / statistics.median(taken[2:]) / 1e6:.3g}")


def move(operator: Operator, device: str) -> None:
    """The weights of a network to the device; formulas have none."""
    if hasattr(operator, "layers"):
        operator.layers = {part: layers.to(device) for part, layers in operator.layers.items()}
