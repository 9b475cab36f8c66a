"""Training of the reflection networks on samples of the reference.

The loss is the measure of errors, |R − S| / (S + E/100), smoothed at zero. The optimiser is Adam, with a rate that
warms up and falls to zero by a cosine. Samples of large error are drawn more often, because the worst case matters as
much as the mean. The weights of the least held-out error are kept. Training stops when that error has not fallen for
PATIENCE points of the curve. Seeds and threads are fixed, so that the same parameters give the same bytes, also after
a kill and a restart.

The paper's networks are trained plainly on rendered pixels (`trained_plainly`), without these improvements.
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

POINTS = 40  # number of points of the training curve
PATIENCE = POINTS // 4
HARD, REPEATED = 0.02, 20.0


class Schedule(msgspec.Struct, frozen=True):
    """Size of a network and course of its training: `steps` of `batch` samples each.

    `rate` is the greatest step of Adam; `width` and `depth` are those of the hidden layers.
    """

    steps: int
    batch: int
    rate: float
    width: int
    depth: int
    seed: int


class Problem(msgspec.Struct, frozen=True):
    """Training data of a network: features, the formula's value, the exact value and the unit of its error."""

    features: Float[Tensor, "n f"]
    sharpness: Float[Tensor, " n"]
    formula: Float[Tensor, " n"]
    exact: Float[Tensor, " n"]
    unit: Float[Tensor, " n"]

    def each(self, change: Callable[[Tensor], Tensor]) -> Problem:
        """Return the problem with `change` applied to every field."""
        return Problem(*(change(getattr(self, name)) for name in self.__struct_fields__))

    def float(self) -> Problem:
        """Convert to float32, the type of training."""
        return self.each(Tensor.float)

    def errors(self, layers: Layers) -> Float[Tensor, " n"]:
        """Return (R − S) / unit of every sample: the network's value R against the exact value S."""
        return (self.formula * torch.exp(correction(layers, self.features, self.sharpness)) - self.exact) / self.unit


def specular_problem(samples: Samples) -> Problem:
    """Return the training data of the specular network at `samples`."""
    form = filtered_specular(*samples.inputs())
    features = specular_features(samples.alpha, samples.no, samples.nz, samples.oz, form)
    return Problem(features, samples.sharpness, form.value, samples.value, samples.scale())


def diffuse_problem(samples: DiffuseSamples) -> Problem:
    """Return the training data of the diffuse network at `samples`."""
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
        """Return the sum of the error quantiles, each in units of its target; smaller is better."""
        return self.held_out_median_error / 0.003 + self.held_out_p95_error / 0.02 + self.held_out_p999_error / 0.1


def train(
    problem: Problem,
    held_out: Problem,
    schedule: Schedule,
    report: Callable[[Step], None],
    checkpoint: Checkpoint | None = None,
) -> tuple[Layers, list[Step]]:
    """Train a network and return the weights of least held-out error, and the training curve.

    Training ends after all steps, or when the held-out error has not fallen for a quarter of them.

    Args:
        problem: Training data.
        held_out: Data that select the weights.
        schedule: Size of the network and course of the training.
        report: Function that receives each point of the curve.
        checkpoint: State to continue from; the result has the same bytes as without interruption.

    Returns:
        The network and the points of its curve.
    """
    problem, held_out, checkpoint = problem.float(), held_out.float(), checkpoint or Checkpoint(None)
    generator = torch.Generator().manual_seed(schedule.seed)
    layers = initial_layers(problem.features, schedule, generator)
    parameters = [*layers.weights, *layers.biases]
    optimiser = torch.optim.Adam(parameters, lr=schedule.rate, betas=(0.9, 0.99), fused=True)
    order, best, curve = torch.empty(0, dtype=torch.long), parameters, []
    # continue from the checkpoint
    if (state := checkpoint.load()) is not None:
        with torch.no_grad():
            for parameter, value in zip(parameters, state["parameters"], strict=True):
                parameter.copy_(value)
        optimiser.load_state_dict(state["optimiser"])
        generator.set_state(state["generator"])
        order, best, curve = state["order"], state["best"], [Step(**point) for point in state["curve"]]
    # train from point to point of the curve, `stretch` steps apart
    stretch = max(1, schedule.steps // POINTS)
    while len(curve) < POINTS and not is_stuck([point.score() for point in curve]):
        total, first = 0.0, len(curve) * stretch
        for step in range(first, first + stretch):
            if len(order) < schedule.batch:
                order = hard_ones_often(problem, layers if curve else None, generator)
            rows, order = order[: schedule.batch], order[schedule.batch :]
            error = problem.each(itemgetter(rows)).errors(layers)
            # loss: √(e² + 1e-6) + 2e², about |e| but smooth at 0; the square makes single large errors count more
            loss = (torch.sqrt(error * error + 1e-6) + 2 * error * error).mean()
            total += descended(optimiser, loss, step, schedule)
        # held-out error; keep the weights of the least score
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
    """Return whether the least score is older than the last PATIENCE points.

    >>> is_stuck([1.0] * PATIENCE), is_stuck([0.5] + [1.0] * PATIENCE)
    (False, True)
    """
    return len(scores) > PATIENCE and min(scores) < min(scores[-PATIENCE:])


def hard_ones_often(problem: Problem, layers: Layers | None, generator: torch.Generator) -> Tensor:
    """Draw a random order of the samples, in which samples of large error occur several times.

    A sample of error e occurs 1 + |e|/HARD times on average, at most REPEATED times.

    Args:
        problem: Training data.
        layers: Network whose errors count; None draws every sample once.
        generator: Random generator.

    Returns:
        Indices of samples.
    """
    times = torch.ones_like(problem.exact)
    if layers is not None:
        with torch.no_grad():
            times = (1 + problem.errors(layers).abs() / HARD).clamp(max=REPEATED)
    # stochastic rounding to whole numbers
    times = torch.floor(times + torch.rand(len(times), generator=generator)).long()
    rows = torch.repeat_interleave(torch.arange(len(times)), times)
    return rows[torch.randperm(len(rows), generator=generator)]


def initial_layers(features: Float[Tensor, "n f"], schedule: Schedule, generator: torch.Generator) -> Layers:
    """Draw the initial weights: variance 1.7 over the number of inputs, a tenth of the deviation in the last layer.

    The small last layer makes the correction begin near 0.

    Args:
        features: Features of the training data, which standardise the network's inputs.
        schedule: Width and depth of the network.
        generator: Random generator.

    Returns:
        A network whose weights require gradients.
    """
    sizes = [features.shape[1], *[schedule.width] * schedule.depth, 1]
    layers = zip(sizes, sizes[1:], strict=False)
    weights = [torch.randn(b, a, generator=generator) * math.sqrt(1.7 / a) for a, b in layers]
    weights[-1] *= 0.1
    biases = [torch.zeros(b) for b in sizes[1:]]
    for tensor in (*weights, *biases):
        tensor.requires_grad_()
    return Layers(features.mean(0), 1 / (features.std(0) + 1e-3), weights, biases)


def descended(optimiser: torch.optim.Optimizer, loss: Tensor, step: int, schedule: Schedule) -> float:
    """Take one step of the optimiser and return the loss before it.

    Args:
        optimiser: Optimiser of the weights.
        loss: Loss, on torch's graph.
        step: Number of the step, which sets the rate.
        schedule: Course of the training.

    Returns:
        The loss.
    """
    warm = min(1.0, (step + 1) / max(1, schedule.steps // 30))
    share = warm * 0.5 * (1 + math.cos(math.pi * min(1.0, step / schedule.steps)))
    for group in optimiser.param_groups:
        group["lr"] = schedule.rate * share
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    return float(loss.detach())


def pixels_problem(inputs: Float[Tensor, "n f"], sharpness: Tensor, radiance: Float[Tensor, " n"]) -> Problem:
    """Return the training data of the paper's network, in float32: rendered radiance of unit lobes at unit reflectance.

    Args:
        inputs: Inputs of the network.
        sharpness: Sharpness λ of each lobe.
        radiance: Rendered radiance.

    Returns:
        Training data whose formula is the lobe's integral.
    """
    energy, radiance = lobe_integral(sharpness.float()), radiance.float()
    return Problem(inputs.float(), sharpness.float(), energy, radiance, radiance + energy / 100)


def trained_plainly(problem: Problem, schedule: Schedule, report: Callable[[int, float], None]) -> Layers:
    """Train a network by Adam on every sample equally often, in random order, and return its last weights.

    Args:
        problem: Training data.
        schedule: Size of the network and course of the training.
        report: Function of the step and the mean error since the last report.

    Returns:
        The network.
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
