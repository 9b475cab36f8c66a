"""Training of the reflection networks on samples of the reference.

The loss is what errors are measured in, |R − S| / (S + E/100), smoothed at its tip; Adam, with a step that warms up and
falls to zero by a cosine; the weights that are kept are those of the least held-out error.  Everything is seeded and the
threads are fixed, so that the same parameters give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.diffuse import diffuse
from factorlib.reflection.filtering import filtered_specular
from factorlib.reflection.network import Layers, correction, diffuse_features, specular_features
from factorlib.reflection.samples import DiffuseSamples, Samples


class Schedule(msgspec.Struct, frozen=True):
    """steps of `batch` samples each;  rate: greatest step of Adam;  width, depth: of the hidden layers."""

    steps: int
    batch: int
    rate: float
    width: int
    depth: int
    seed: int


class Problem(msgspec.Struct, frozen=True):
    """What a network is fitted to: features, the formula's value, the exact value and the unit of its error."""

    features: Float[Tensor, "n f"]
    sharpness: Float[Tensor, "n"]
    formula: Float[Tensor, "n"]
    exact: Float[Tensor, "n"]
    unit: Float[Tensor, "n"]

    def rows(self, index) -> Problem:
        return Problem(*(getattr(self, name)[index] for name in self.__struct_fields__))

    def float(self) -> Problem:
        return Problem(*(getattr(self, name).float() for name in self.__struct_fields__))

    def errors(self, layers: Layers) -> Float[Tensor, "n"]:
        return (self.formula * torch.exp(correction(layers, self.features, self.sharpness)) - self.exact) / self.unit


def specular_problem(samples: Samples) -> Problem:
    form = filtered_specular(*samples.inputs())
    features = specular_features(samples.alpha, samples.no, samples.nz, samples.oz, form)
    return Problem(features, samples.sharpness, form.value, samples.value, samples.scale())


def diffuse_problem(samples: DiffuseSamples) -> Problem:
    formula = diffuse(samples.sharpness, samples.nz)
    return Problem(diffuse_features(samples.sharpness, samples.nz), samples.sharpness, formula, samples.value, samples.scale())


class Step(msgspec.Struct, frozen=True):
    """One point of the training curve."""

    step: int
    training_loss: float
    held_out_median_error: float
    held_out_p95_error: float


def train(problem: Problem, held_out: Problem, schedule: Schedule, report: Callable[[Step], None]) -> tuple[Layers, list[Step]]:
    """The network of least held-out error, and the curve."""
    problem, held_out = problem.float(), held_out.float()
    generator = torch.Generator().manual_seed(schedule.seed)
    layers = initial_layers(problem.features, schedule, generator)
    parameters = [*layers.weights, *layers.biases]
    optimiser = torch.optim.Adam(parameters, lr=schedule.rate, betas=(0.9, 0.99), fused=True)
    slope = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda k: _rate(k, schedule.steps))
    best, kept, curve, running = math.inf, layers, [], 0.0
    every = max(1, schedule.steps // 40)
    order = torch.empty(0, dtype=torch.long)
    for step in range(1, schedule.steps + 1):
        if len(order) < schedule.batch:
            order = torch.randperm(len(problem.exact), generator=generator)
        batch, order = problem.rows(order[: schedule.batch]), order[schedule.batch :]
        loss = robust(batch.errors(layers)).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        slope.step()
        running += (float(loss.detach()) - running) / min(step, every)
        if step % every == 0:
            point = _measured(step, running, layers, held_out)
            curve.append(point)
            report(point)
            if (score := point.held_out_median_error + 0.1 * point.held_out_p95_error) < best:
                best, kept = score, _copy(layers)
    return kept, curve


def robust(error: Tensor) -> Tensor:
    """|e| away from its tip, and more than that where e is large, so that no single case is left behind."""
    return torch.sqrt(error * error + 1e-6) + 2 * error * error


def initial_layers(features: Float[Tensor, "n f"], schedule: Schedule, generator: torch.Generator) -> Layers:
    sizes = [features.shape[1], *[schedule.width] * schedule.depth, 1]
    weights = [torch.randn(b, a, generator=generator) * math.sqrt(1.7 / a) for a, b in zip(sizes, sizes[1:], strict=False)]
    weights[-1] *= 0.1
    biases = [torch.zeros(b) for b in sizes[1:]]
    for tensor in (*weights, *biases):
        tensor.requires_grad_()
    return Layers(features.mean(0), 1 / (features.std(0) + 1e-3), weights, biases)


def _rate(step: int, steps: int) -> float:
    warm = min(1.0, (step + 1) / max(1, steps // 30))
    return warm * 0.5 * (1 + math.cos(math.pi * min(1.0, step / steps)))


def _measured(step: int, loss: float, layers: Layers, held_out: Problem) -> Step:
    with torch.no_grad():
        error = held_out.errors(layers).abs()
    return Step(step, loss, float(error.median()), float(error.quantile(0.95)))


def _copy(layers: Layers) -> Layers:
    return Layers(layers.mean, layers.scale, [w.detach().clone() for w in layers.weights], [b.detach().clone() for b in layers.biases])
