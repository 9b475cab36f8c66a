"""Training of the paper's operator on rendered pixels, plainly: what improves the project's own networks stays out of it.

The loss is |R − S| / (S + E/100), smoothed at its tip, R = E(λ) exp(…) as in `paper_network`.  Adam sees every pixel
equally often, in random order, with a step that warms up and falls to zero by a cosine; the last weights are kept.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.network import Layers, correction
from factorlib.reflection.training import Schedule, initial_layers, share_of_rate


class Examples(msgspec.Struct, frozen=True):
    """Inputs of a network, and the radiance that was rendered of a unit lobe at unit reflectance."""

    inputs: Float[Tensor, "n f"]
    sharpness: Float[Tensor, " n"]
    radiance: Float[Tensor, " n"]


def trained(examples: Examples, schedule: Schedule, report: Callable[[int, float], None]) -> Layers:
    """The network after all steps; `report` takes the step and the mean error since the last report."""
    generator = torch.Generator().manual_seed(schedule.seed)
    inputs, sharpness, radiance = (t.float() for t in (examples.inputs, examples.sharpness, examples.radiance))
    energy = lobe_integral(sharpness)
    layers = initial_layers(inputs, schedule, generator)
    optimiser = torch.optim.Adam([*layers.weights, *layers.biases], lr=schedule.rate, betas=(0.9, 0.99), fused=True)
    slope = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: share_of_rate(step, schedule.steps))
    every, total, order = max(1, schedule.steps // 20), 0.0, torch.empty(0, dtype=torch.long)
    for step in range(1, schedule.steps + 1):
        if len(order) < schedule.batch:
            order = torch.randperm(len(radiance), generator=generator)
        rows, order = order[: schedule.batch], order[schedule.batch :]
        radiated = energy[rows] * torch.exp(correction(layers, inputs[rows], sharpness[rows]))
        error = (radiated - radiance[rows]) / (radiance[rows] + energy[rows] / 100)
        loss = torch.sqrt(error * error + 1e-6).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        slope.step()
        total += float(loss.detach())
        if step % every == 0:
            report(step, total / every)
            total = 0.0
    return layers
