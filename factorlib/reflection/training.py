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
    """What the specular network is fitted to, at `samples`."""
    form = filtered_specular(*samples.inputs())
    features = specular_features(samples.alpha, samples.no, samples.nz, samples.oz, form)
    return Problem(features, samples.sharpness, form.value, samples.value, samples.scale())


def diffuse_problem(samples: DiffuseSamples) -> Problem:
    """What the diffuse network is fitted to, at `samples`."""
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
        """Which of two networks is better: each quantile in units of what is wanted of it."""
        return self.held_out_median_error / 0.003 + self.held_out_p95_error / 0.02 + self.held_out_p999_error / 0.1


def train(
    problem: Problem, held_out: Problem, schedule: Schedule, report: Callable[[Step], None], checkpoint: Checkpoint | None = None
) -> tuple[Layers, list[Step]]:  # fmt: skip
    """The network of least held-out error, and the curve; goes on from `checkpoint`, to the same bytes."""
    run, checkpoint = Run(problem.float(), held_out.float(), schedule), checkpoint or Checkpoint(None)
    if (state := checkpoint.load()) is not None:
        run.load_state(state)
    while not run.finished():
        report(run.advance())
        checkpoint.save(run.state())
    return run.best, run.curve


class Run:
    """A training run that can be stopped between any two points of its curve."""

    def __init__(self, problem: Problem, held_out: Problem, schedule: Schedule):
        self.problem, self.held_out, self.schedule = problem, held_out, schedule
        self.generator = torch.Generator().manual_seed(schedule.seed)
        self.layers = initial_layers(problem.features, schedule, self.generator)
        self.parameters = [*self.layers.weights, *self.layers.biases]
        self.optimiser = torch.optim.Adam(self.parameters, lr=schedule.rate, betas=(0.9, 0.99), fused=True)
        self.order = torch.empty(0, dtype=torch.long)
        self.best, self.curve = self.layers, []
        self.stretch = max(1, schedule.steps // POINTS)  # steps between two points of the curve

    def finished(self) -> bool:
        """All steps are done, or the held-out error has not fallen for a quarter of them."""
        scores = [point.score() for point in self.curve]
        return len(scores) >= POINTS or (len(scores) > PATIENCE and min(scores) < min(scores[-PATIENCE:]))

    def advance(self) -> Step:
        """Train to the next point of the curve."""
        total, first = 0.0, len(self.curve) * self.stretch
        for step in range(first, first + self.stretch):
            if len(self.order) < self.schedule.batch:
                self.order = self._reshuffled()
            rows, self.order = self.order[: self.schedule.batch], self.order[self.schedule.batch :]
            error = self.problem.each(lambda field, rows=rows: field[rows]).errors(self.layers)
            # about |e|, smooth at 0, plus 2e², so that single large errors count more
            loss = (torch.sqrt(error * error + 1e-6) + 2 * error * error).mean()
            total += descended(self.optimiser, loss, step, self.schedule)
        with torch.no_grad():
            error = self.held_out.errors(self.layers).abs()
        quantiles = (float(error.quantile(q)) for q in (0.5, 0.95, 0.999))
        point = Step(first + self.stretch, total / self.stretch, *quantiles)
        if all(point.score() < earlier.score() for earlier in self.curve):
            kept = ([t.detach().clone() for t in tensors] for tensors in (self.layers.weights, self.layers.biases))
            self.best = Layers(self.layers.mean, self.layers.scale, *kept)
        self.curve.append(point)
        return point

    def _reshuffled(self) -> Tensor:
        """Every sample once, and those of large error up to REPEATED times more, in random order."""
        with torch.no_grad():
            error = self.problem.errors(self.layers).abs()
        times = (1 + error / HARD).clamp(max=REPEATED) if self.curve else torch.ones_like(error)
        times = torch.floor(times + torch.rand(len(error), generator=self.generator)).long()
        rows = torch.repeat_interleave(torch.arange(len(error)), times)
        return rows[torch.randperm(len(rows), generator=self.generator)]

    def state(self) -> dict:
        """All that `load_state` needs to go on to the same bytes."""
        return {
            "parameters": [p.detach() for p in self.parameters],
            "best": [*self.best.weights, *self.best.biases],
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "order": self.order,
            "curve": [msgspec.structs.asdict(point) for point in self.curve],
        }

    def load_state(self, state: dict) -> None:
        """Go on from a `state` of a run with the same problem and schedule."""
        with torch.no_grad():
            for parameter, value in zip(self.parameters, state["parameters"], strict=True):
                parameter.copy_(value)
        count = len(self.layers.weights)
        self.best = Layers(self.layers.mean, self.layers.scale, state["best"][:count], state["best"][count:])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.order = state["order"]
        self.curve = [Step(**point) for point in state["curve"]]


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
    """What the paper's network is fitted to: rendered radiance of unit lobes at unit reflectance; in float32."""
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
        error = problem.each(lambda field, rows=rows: field[rows]).errors(layers)
        total += descended(optimiser, torch.sqrt(error * error + 1e-6).mean(), step, schedule)
        if (step + 1) % every == 0:
            report(step + 1, total / every)
            total = 0.0
    return layers
