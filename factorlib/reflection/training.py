"""Training of the reflection networks on samples of the reference.

The loss is what errors are measured in, |R − S| / (S + E/100), smoothed at its tip; Adam, with a step that warms up and
falls to zero by a cosine.  Samples of large error are drawn more often, because the worst case matters as much as the mean.  The
weights of the least held-out error are kept, and training stops when that error has not fallen for PATIENCE points of the curve.
Seeds and threads are fixed, so that the same parameters give the same bytes, also after a kill and a restart.

The paper's networks are trained plainly on rendered pixels (`trained_plainly`): what improves the project's own stays out of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import itemgetter

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.checkpoint import Checkpoint
from factorlib.reflection.closed_form import diffuse
from factorlib.reflection.filtering import filtered_specular
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.network import Layers, correction, diffuse_features, specular_features
from factorlib.reflection.samples import DiffuseSamples, Samples

POINTS = 40  # of the training curve
PATIENCE = POINTS // 4
HARD, REPEATED = 0.02, 20.0  # samples of this error are seen twice as often, and the worst this often


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
    sharpness: Float[Tensor, " n"]
    formula: Float[Tensor, " n"]
    exact: Float[Tensor, " n"]
    unit: Float[Tensor, " n"]

    def each(self, change: Callable[[Tensor], Tensor]) -> Problem:
        """The problem with `change` made to every field."""
        return Problem(*(change(getattr(self, name)) for name in self.__struct_fields__))

    def float(self) -> Problem:
        """The same in float32, in which networks are trained."""
        return self.each(Tensor.float)

    def errors(self, layers: Layers) -> Float[Tensor, " n"]:
        """(R − S) / unit of every sample: the network's value R against the exact value S."""
        return (self.formula * torch.exp(correction(layers, self.features, self.sharpness)) - self.exact) / self.unit


def specular_problem(samples: Samples) -> Problem:
    """Return what the specular network is fitted to, at `samples`."""
    form = filtered_specular(*samples.inputs())
    features = specular_features(samples.alpha, samples.no, samples.nz, samples.oz, form)
    return Problem(features, samples.sharpness, form.value, samples.value, samples.scale())


def diffuse_problem(samples: DiffuseSamples) -> Problem:
    """Return what the diffuse network is fitted to, at `samples`."""
    formula, features = (f(samples.sharpness, samples.nz) for f in (diffuse, diffuse_features))
    return Problem(features, samples.sharpness, formula, samples.value, samples.scale())


class Step(msgspec.Struct, frozen=True):
    """One point of the training curve."""

    step: int
    training_loss: float
    held_out_median_error: float
    held_out_p95_error: float
    held_out_p999_error: float

    def score(self) -> float:
        """Return which of two networks is better: each quantile in units of what is wanted of it."""
        return self.held_out_median_error / 0.003 + self.held_out_p95_error / 0.02 + self.held_out_p999_error / 0.1


def train(
    problem: Problem, held_out: Problem, schedule: Schedule, report: Callable[[Step], None], checkpoint: Checkpoint | None = None
) -> tuple[Layers, list[Step]]:  # fmt: skip
    """The network of least held-out error, and the curve; goes on from `checkpoint`, to the same bytes.

    It ends where all steps are done, or the held-out error has not fallen for a quarter of them.
    """
    problem, held_out, checkpoint = problem.float(), held_out.float(), checkpoint or Checkpoint(None)
    generator = torch.Generator().manual_seed(schedule.seed)
    layers = initial_layers(problem.features, schedule, generator)
    parameters = [*layers.weights, *layers.biases]
    optimiser = torch.optim.Adam(parameters, lr=schedule.rate, betas=(0.9, 0.99), fused=True)
    order, best, curve = torch.empty(0, dtype=torch.long), parameters, []
    if (state := checkpoint.load()) is not None:
        with torch.no_grad():
            for parameter, value in zip(parameters, state["parameters"], strict=True):
                parameter.copy_(value)
        optimiser.load_state_dict(state["optimiser"])
        generator.set_state(state["generator"])
        order, best, curve = state["order"], state["best"], [Step(**point) for point in state["curve"]]
    stretch = max(1, schedule.steps // POINTS)  # steps between two points of the curve
    while len(curve) < POINTS and not is_stuck([point.score() for point in curve]):
        total, first = 0.0, len(curve) * stretch
        for step in range(first, first + stretch):
            if len(order) < schedule.batch:
                order = hard_ones_often(problem, layers if curve else None, generator)
            rows, order = order[: schedule.batch], order[schedule.batch :]
            error = problem.each(itemgetter(rows)).errors(layers)
            # about |e|, smooth at 0, plus 2e², so that single large errors count more
            loss = (torch.sqrt(error * error + 1e-6) + 2 * error * error).mean()
            total += descended(optimiser, loss, step, schedule)
        with torch.no_grad():
            error = held_out.errors(layers).abs()
        quantiles = (float(error.quantile(q)) for q in (0.5, 0.95, 0.999))
        point = Step(first + stretch, total / stretch, *quantiles)
        if all(point.score() < earlier.score() for earlier in curve):
            best = [t.detach().clone() for t in parameters]
        curve.append(point)
        report(point)
        state = {"parameters": [t.detach() for t in parameters], "best": best, "optimiser": optimiser.state_dict()}
        points = [msgspec.structs.asdict(point) for point in curve]
        checkpoint.save(state | {"generator": generator.get_state(), "order": order, "curve": points})
    count = len(layers.weights)
    return Layers(layers.mean, layers.scale, best[:count], best[count:]), curve


def is_stuck(scores: list[float]) -> bool:
    """The least score is not among the last PATIENCE.

    >>> is_stuck([1.0] * PATIENCE), is_stuck([0.5] + [1.0] * PATIENCE)
    (False, True)
    """
    return len(scores) > PATIENCE and min(scores) < min(scores[-PATIENCE:])


def hard_ones_often(problem: Problem, layers: Layers | None, generator: torch.Generator) -> Tensor:
    """Every sample once, and those on which `layers` are far off up to REPEATED times more, in random order."""
    times = torch.ones_like(problem.exact)
    if layers is not None:
        with torch.no_grad():
            times = (1 + problem.errors(layers).abs() / HARD).clamp(max=REPEATED)
    times = torch.floor(times + torch.rand(len(times), generator=generator)).long()
    rows = torch.repeat_interleave(torch.arange(len(times)), times)
    return rows[torch.randperm(len(rows), generator=generator)]


def initial_layers(features: Float[Tensor, "n f"], schedule: Schedule, generator: torch.Generator) -> Layers:
    """Random weights of variance 1.7 over the number of inputs, the last layer's a tenth as large, so that the correction begins near 0."""
    sizes = [features.shape[1], *[schedule.width] * schedule.depth, 1]
    layers = zip(sizes, sizes[1:], strict=False)
    weights = [torch.randn(b, a, generator=generator) * math.sqrt(1.7 / a) for a, b in layers]
    weights[-1] *= 0.1
    biases = [torch.zeros(b) for b in sizes[1:]]
    for tensor in (*weights, *biases):
        tensor.requires_grad_()
    return Layers(features.mean(0), 1 / (features.std(0) + 1e-3), weights, biases)


def descended(optimiser: torch.optim.Optimizer, loss: Tensor, step: int, schedule: Schedule) -> float:
    """The loss before step `step` down its gradient, whose rate warms up and falls to zero by a cosine."""
    warm = min(1.0, (step + 1) / max(1, schedule.steps // 30))
    share = warm * 0.5 * (1 + math.cos(math.pi * min(1.0, step / schedule.steps)))
    for group in optimiser.param_groups:
        group["lr"] = schedule.rate * share
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    return float(loss.detach())


def pixels_problem(inputs: Float[Tensor, "n f"], sharpness: Tensor, radiance: Float[Tensor, " n"]) -> Problem:
    """Return what the paper's network is fitted to: rendered radiance of unit lobes at unit reflectance; in float32."""
    energy, radiance = lobe_integral(sharpness.float()), radiance.float()
    return Problem(inputs.float(), sharpness.float(), energy, radiance, radiance + energy / 100)


def trained_plainly(problem: Problem, schedule: Schedule, report: Callable[[int, float], None]) -> Layers:
    """The network of the last step; Adam sees every sample equally often, in random order.

    report: takes the step and the mean error since the last report
    """
    generator = torch.Generator().manual_seed(schedule.seed)
    layers = initial_layers(problem.features, schedule, generator)
    optimiser = torch.optim.Adam([*layers.weights, *layers.biases], lr=schedule.rate, betas=(0.9, 0.99), fused=True)
    every, total, order = max(1, schedule.steps // 20), 0.0, torch.empty(0, dtype=torch.long)
    for step in range(schedule.steps):
        if len(order) < schedule.batch:
            order = torch.randperm(len(problem.exact), generator=generator)
        rows, order = order[: schedule.batch], order[schedule.batch :]
        error = problem.each(itemgetter(rows)).errors(layers)
        total += descended(optimiser, torch.sqrt(error * error + 1e-6).mean(), step, schedule)
        if (step + 1) % every == 0:
            report(step + 1, total / every)
            total = 0.0
    return layers
