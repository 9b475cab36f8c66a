"""Training the reflection networks from nothing: samples by quadrature, Adam on the relative error.

The error is that of the operator's evaluation, |R − S| / (S + E/100), with S the reference and E the lobe's integral;
training lowers its pseudo-Huber mean.  The weights kept are those of the least held-out 95th percentile.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import torch
from torch import Tensor

from factorlib.reflection.brdf import lobe_integral
from factorlib.reflection.network import FEATURES, Correction, corrected_diffuse, corrected_specular, diffuse_features, specular_features
from factorlib.reflection.reference import diffuse_by_quadrature, specular_by_quadrature

Report = Callable[[float, float, str], None]
BATCH = 500  # samples whose quadrature is done at once


class Training(msgspec.Struct, frozen=True):
    """samples and steps of the specular network; polar × azimuth nodes of its quadrature (error below 1e-3 for 95 %)."""

    samples: int = 120_000
    held_out: int = 8_000
    steps: int = 4_000
    batch: int = 4_096
    width: int = 64
    depth: int = 3
    rate: float = 4e-3
    polar: int = 48
    azimuth: int = 64
    seed: int = 0


class Curve(msgspec.Struct, frozen=True):
    part: str
    step: int
    loss: float
    median: float
    p95: float
    worst: float


def specular_cases(count: int, seed: int) -> list[Tensor]:
    """roughness, sharpness, n·o, n·z, o·z: α log-uniform .01–1, λ log-uniform .1–5000, n·o uniform .02–1; the axis around the
    mirror direction with a spread of 2√(α²/2 + 1/λ) for two thirds, uniform on the sphere for one third."""
    g = torch.Generator().manual_seed(seed)
    uniform = lambda: torch.rand(count, generator=g, dtype=torch.float64)  # noqa: E731
    normal = lambda: torch.randn(count, 3, generator=g, dtype=torch.float64)  # noqa: E731
    alpha, sharpness, no = 0.01 * 100 ** uniform(), 0.1 * 50_000 ** uniform(), 0.02 + 0.98 * uniform()
    sin = torch.sqrt(1 - no**2)
    view = torch.stack([sin, 0 * no, no], 1)
    near = view * torch.tensor([-1.0, 1.0, 1.0]) + 2 * torch.sqrt(alpha**2 / 2 + 1 / sharpness)[:, None] * normal()
    axis = torch.where((uniform() < 2 / 3)[:, None], near, normal())
    axis = axis / axis.norm(dim=1, keepdim=True)
    return [alpha.sqrt(), sharpness, no, axis[:, 2], (axis * view).sum(1)]


def diffuse_cases(count: int, seed: int) -> list[Tensor]:
    """sharpness log-uniform .05–5000 and n·z: half uniform, half within three widths of the horizon."""
    g = torch.Generator().manual_seed(seed)
    sharpness = 0.05 * 100_000 ** torch.rand(count, generator=g, dtype=torch.float64)
    uniform = 2 * torch.rand(count, generator=g, dtype=torch.float64) - 1
    near = (3 * uniform / torch.sqrt(sharpness)).clamp(-1, 1)
    return [sharpness, torch.where(torch.rand(count, generator=g) < 0.5, uniform, near)]


def relative_error(value: Tensor, reference: Tensor, sharpness: Tensor) -> Tensor:
    """(R − S) / (S + E/100)."""
    return (value - reference) / (reference + lobe_integral(sharpness) / 100)


def specular_reference(cases: list[Tensor], polar: int, azimuth: int, report: Report = lambda *_: None) -> Tensor:
    count = len(cases[0])
    values = []
    for i in range(0, count, BATCH):
        values.append(specular_by_quadrature(*(c[i : i + BATCH] for c in cases), polar, azimuth))
        report(i / count, 1.0, "samples")
    return torch.cat(values)


def trained_networks(training: Training, report: Report = lambda *_: None) -> tuple[dict[str, Correction], list[Curve]]:
    """Both networks and their training curves; the same `training` gives the same weights on the same number of threads."""
    t = training
    cases = specular_cases(t.samples + t.held_out, t.seed + 1)
    values = specular_reference(cases, t.polar, t.azimuth, lambda done, _, text: report(0.3 * done, 1.0, text))
    specular = _fitted("specular", cases, values, training, lambda done, text: report(0.3 + 0.6 * done, 1.0, text))
    cases = diffuse_cases(t.samples // 4 + t.held_out, t.seed + 2)
    small = msgspec.structs.replace(t, width=24, depth=2, steps=max(t.steps // 2, 1))
    diffuse = _fitted("diffuse", cases, diffuse_by_quadrature(*cases), small, lambda done, text: report(0.9 + 0.1 * done, 1.0, text))
    return {"diffuse": diffuse[0], "specular": specular[0]}, [*diffuse[1], *specular[1]]


EVALUATE = {"diffuse": corrected_diffuse, "specular": corrected_specular}
FEATURES_OF = {"diffuse": diffuse_features, "specular": specular_features}


def _fitted(part: str, cases: list[Tensor], values: Tensor, t: Training, report: Callable) -> tuple[Correction, list[Curve]]:
    torch.manual_seed(t.seed)
    network = Correction(FEATURES[part], t.width, t.depth)
    held = [c[-t.held_out :].float() for c in (*cases, values)]
    train = [c[: -t.held_out].float() for c in (*cases, values)]
    features = FEATURES_OF[part](*train[:-1])
    network.mean.copy_(features.mean(0))
    network.deviation.copy_(features.std(0))
    sharpness_at = {"diffuse": 0, "specular": 1}[part]
    optimiser = torch.optim.Adam(network.parameters(), lr=t.rate, betas=(0.9, 0.98))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, t.rate, total_steps=t.steps, pct_start=0.05)
    generator = torch.Generator().manual_seed(t.seed)
    curve, best, kept = [], float("inf"), None
    for step in range(t.steps):
        rows = torch.randint(len(train[0]), (t.batch,), generator=generator)
        batch = [c[rows] for c in train]
        error = relative_error(EVALUATE[part](network, *batch[:-1]), batch[-1], batch[sharpness_at])
        scale = 0.02
        loss = (scale * (torch.sqrt(1 + (error / scale) ** 2) - 1)).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if (step + 1) % max(t.steps // 20, 1) == 0:
            curve.append(_point(part, step + 1, float(loss), network, held, sharpness_at))
            report((step + 1) / t.steps, f"{part} step {step + 1}: error {curve[-1].median:.2%}, 95th percentile {curve[-1].p95:.2%}")
            if curve[-1].p95 < best:
                best, kept = curve[-1].p95, {k: v.clone() for k, v in network.state_dict().items()}
    network.load_state_dict(kept)
    return network.eval().requires_grad_(False), curve


def _point(part: str, step: int, loss: float, network: Correction, held: list[Tensor], sharpness_at: int) -> Curve:
    with torch.no_grad():
        error = relative_error(EVALUATE[part](network, *held[:-1]), held[-1], held[sharpness_at]).abs()
    return Curve(part, step, loss, float(error.median()), float(error.quantile(0.95)), float(error.max()))
