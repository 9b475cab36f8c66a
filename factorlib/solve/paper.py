"""The paper's solver: limited-memory quasi-Newton steps on random subsets of the observations (arXiv 1710.08313).

    minimise  mean over observations and channels of (y − radiance)² / σ²  +  π · mean over lights of Var_c(W_c) / W̄²

with y the prediction of `normal_equations`, σ its noise model, W_c the summed lobe weights of channel c and W̄ their mean.  Wang, Ritschel and Mitra say: L-BFGS; another random subset at every iteration; each
observation sampled 5 times on average; n_p = 32 lobes an illumination; π = 0.1.  This is the baseline of every comparison.

Left open by the paper, or by what is known of it here, and chosen:

Bounds       by parametrisation: reflectances and roughness through a sigmoid, log sharpness through a sigmoid onto
             `SHARPNESS`, weights through softplus, axes as unnormalised vectors.
Start        reflectances from mean radiances (`start`), lobes evenly over the sphere, as wide as they are apart, white.
Subset       `subset` observations of all illuminations together.
Curvature    a pair (step, change of gradient) is measured on one subset, at both ends of the step, so that the change
             of subset is not taken for curvature (Schraudolph, Yu and Günter 2007, "A stochastic quasi-Newton method for
             online convex optimization"); pairs outlive their subset.
Residuals    whitened by the noise model.  With plain differences the subsets' highlights rule: on three materials in two
             known lights the held-out loss stayed ten times as high.
Step         halved until it lowers the objective enough (Armijo), no further than `LARGEST_STEP` in any unknown: longer
             ones drive the sigmoids to where their slopes vanish.
Clipping     at least this much, as in the bundle solver: a clipped channel pulls from below only.
Exposures    of photos that share a light, beyond the first: unknowns of their own.
Not modelled are self-shadowing, robustness against outliers, and how many lobes a light needs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.light.sphere import fibonacci_sphere
from factorlib.solve.bundle import Joint
from factorlib.solve.descent import Solution, evaluated
from factorlib.solve.gauge import in_gauge
from factorlib.solve.held_out import held_out_loss
from factorlib.solve.history import Event, Report, Snapshot, unwatched
from factorlib.solve.normal_equations import Loss
from factorlib.solve.problem import Block
from factorlib.solve.shadowing import without_shadows
from factorlib.solve.start import starting_materials
from factorlib.solve.unknowns import ROUGHNESS, SHARPNESS, Light, Materials

MEMORY = 20  # pairs
LARGEST_STEP = 0.05
SUFFICIENT, HALVINGS = 1e-4, 12
REPORTS = 20  # in a run


class Paper(msgspec.Struct, frozen=True):
    """lobes: an illumination;  samplings: of each observation, on average over the run;  prior: π."""

    lobes: int = 32
    samplings: float = 5.0
    subset: int = 512
    prior: float = 0.1
    start_roughness: float = 0.4
    start_specular_share: float = 0.2
    seed: int = 0


def solve(
    blocks: Sequence[Block], materials: int, operator, paper: Paper, map_: Callable, report: Report, snapshot: Snapshot = unwatched
) -> Joint:
    """As of the bundle solver: materials 0 … `materials`−1 and one light per block, in the gauge of `solve.gauge`."""
    blocks = [without_shadows(block) for block in blocks]
    problem, history, loss = Problem(blocks, materials, operator, paper), [], Loss(prior=paper.prior)
    rows = [np.flatnonzero(~block.held_out) for block in blocks]
    iterations = math.ceil(paper.samplings * sum(map(len, rows)) / paper.subset)
    every = max(1, iterations // REPORTS)
    x, pairs, random = problem.start(), deque(maxlen=MEMORY), np.random.default_rng(paper.seed)
    for iteration in range(iterations):
        subset = drawn(rows, paper.subset, random)
        x, value = stepped(lambda at, s=subset: problem.objective(at, s), x, pairs)
        if (iteration + 1) % every == 0 or iteration + 1 == iterations:
            solution = problem.solution(x)
            held = held_out_loss(blocks, solution.materials, solution.lights, operator, loss)
            history.append(Event((iteration + 1) // every - 1, "subset", iteration, value, held, paper.lobes * len(blocks)))
            report(history[-1])
            snapshot(history[-1], solution)
    found = problem.solution(x)
    everything = [msgspec.structs.replace(block, held_out=np.zeros(len(block), bool)) for block in blocks]
    final = evaluated(everything, *in_gauge(found.materials, found.lights, blocks), operator, loss, map_)
    return Joint(final, history, loss, matte=np.zeros(materials, bool))


def drawn(rows: Sequence[Int[np.ndarray, "_"]], count: int, random: np.random.Generator) -> list[Int[np.ndarray, "_"]]:
    """`count` of all rows, without replacement, as a list per block."""
    starts = np.cumsum([0, *map(len, rows)])
    chosen = np.sort(random.choice(starts[-1], min(count, starts[-1]), replace=False))
    return [own[chosen[(chosen >= a) & (chosen < b)] - a] for own, a, b in zip(rows, starts[:-1], starts[1:], strict=True)]


def stepped(objective: Callable, x: Tensor, pairs: deque) -> tuple[Tensor, float]:
    """x after one step on one subset, and the objective there; the pair that was measured joins `pairs`."""
    value, gradient = objective(x)
    direction = -inverse_hessian_times(gradient, pairs)
    direction = direction * min(1.0, LARGEST_STEP / max(float(direction.abs().max()), 1e-30))
    slope, length = float(gradient @ direction), 1.0
    for _ in range(HALVINGS):
        trial = x + length * direction
        trial_value, trial_gradient = objective(trial)
        if trial_value <= value + SUFFICIENT * length * slope:
            step, change = trial - x, trial_gradient - gradient
            if float(step @ change) > 1e-8 * float(step.norm() * change.norm()):
                pairs.append((step, change))
            return trial, trial_value
        length /= 2
    pairs.clear()
    return x, value


def inverse_hessian_times(gradient: Tensor, pairs: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """The two-loop recursion (Nocedal 1980); with no pair yet, the gradient at a tenth of its own size."""
    q, alphas = gradient.clone(), []
    for step, change in reversed(pairs):
        alphas.append(float(step @ q) / float(step @ change))
        q -= alphas[-1] * change
    if not pairs:
        return 0.1 * q / max(float(gradient.abs().max()), 1e-30)
    step, change = pairs[-1]
    q *= float(step @ change) / float(change @ change)
    for (step, change), alpha in zip(pairs, reversed(alphas), strict=True):
        q += (alpha - float(change @ q) / float(step @ change)) * step
    return q


class Problem:
    """The objective as a function of one unbounded vector: 7 a material, then 7 a lobe (axis 3, sharpness, weight 3) and
    the exposures of each light in turn; float64."""

    def __init__(self, blocks: Sequence[Block], materials: int, operator, paper: Paper):
        self.blocks, self.operator, self.paper = blocks, operator, paper
        self.begin = starting_materials(blocks, materials, paper.start_specular_share, paper.start_roughness)
        self.sizes = [7 * materials] + [7 * paper.lobes + len(block.photos) - 1 for block in blocks]

    def start(self) -> Float[Tensor, "k"]:
        """Even lobes under which the block's mean radiance, 1, is what its materials reflect."""
        p, begin = self.paper.lobes, self.begin
        bounded = np.column_stack([begin.diffuse, begin.specular, _share(begin.roughness, ROUGHNESS)])
        sharpness = p / 2  # 1/λ of a lobe's variance, where p of them cover 4π
        parts = [_logit(bounded).reshape(-1)]
        for block in self.blocks:
            reflectance = (begin.diffuse + begin.specular)[block.material].mean(0)
            weight = np.tile(block.radiance.mean(0) / np.maximum(reflectance, 1e-3), (p, 1))
            level = np.full((p, 1), _logit(_share(np.log(sharpness), np.log(SHARPNESS))))
            parts += [np.hstack([fibonacci_sphere(p), level, np.log(np.expm1(weight))]).reshape(-1), np.zeros(len(block.photos) - 1)]
        return torch.from_numpy(np.concatenate(parts))

    def unpacked(self, x: Tensor) -> tuple[tuple[Tensor, ...], list[tuple[Tensor, ...]]]:
        """(diffuse, specular, roughness) and, of each light, (axis, log sharpness, weight, log exposure)."""
        parts = torch.split(x, self.sizes)
        bounded = torch.sigmoid(parts[0].reshape(-1, 7))
        low, high = ROUGHNESS
        materials = bounded[:, :3], bounded[:, 3:6], low + (high - low) * bounded[:, 6]
        return materials, [self._light(part) for part in parts[1:]]

    def _light(self, part: Tensor) -> tuple[Tensor, ...]:
        rows = part[: 7 * self.paper.lobes].reshape(-1, 7)
        low, high = np.log(SHARPNESS)
        axis = torch.nn.functional.normalize(rows[:, :3], dim=1)
        exposure = torch.cat([part.new_zeros(1), part[7 * self.paper.lobes :]])
        return axis, low + (high - low) * torch.sigmoid(rows[:, 3]), torch.nn.functional.softplus(rows[:, 4:]), exposure

    def solution(self, x: Tensor) -> Solution:
        """As the bundle solver has it, without normal equations."""
        materials, lights = self.unpacked(x)
        vector = torch.cat([materials[0], materials[1], materials[2][:, None]], 1).reshape(-1).numpy()
        return Solution(Materials.of_vector(vector), [Light(*(t.numpy() for t in light)) for light in lights], [])

    def objective(self, x: Tensor, subset: Sequence[Int[np.ndarray, "_"]]) -> tuple[float, Tensor]:
        """Value and gradient on the subset."""
        x = x.detach().requires_grad_()
        (diffuse, specular, roughness), lights = self.unpacked(x)
        squares, values, prior = x.new_zeros(()), 0, x.new_zeros(())
        for block, light, rows in zip(self.blocks, lights, subset, strict=True):
            prior = prior + _variance(light[2].sum(0))
            for m in np.unique(block.material[rows]).tolist():
                own = rows[block.material[rows] == m]
                predicted = self._predicted(block, own, light, diffuse[m], specular[m], roughness[m])
                difference = (predicted - torch.from_numpy(block.radiance[own])) * torch.from_numpy(block.precision[own])
                satisfied = torch.from_numpy(block.clipped[own]) & (difference > 0)
                squares = squares + (difference.masked_fill(satisfied, 0.0) ** 2).sum()
                values += difference.numel()
        value = squares / max(values, 1) + self.paper.prior * prior / len(self.blocks)
        value.backward()
        return value.item(), x.grad

    def _predicted(self, block: Block, rows, light, diffuse: Tensor, specular: Tensor, roughness: Tensor) -> Float[Tensor, "n 3"]:
        axis, log_sharpness, weight, log_exposure = light
        normal, view = torch.from_numpy(block.normal[rows]), torch.from_numpy(block.view[rows])
        no, nz, oz = (normal * view).sum(1), normal @ axis.T, view @ axis.T
        matte, glossy = Reflected.apply(self.operator, roughness, log_sharpness, no, nz, oz)
        exposure = torch.exp(log_exposure)[torch.from_numpy(block.photo[rows])]
        return exposure[:, None] * (diffuse * (matte @ weight) + specular * (glossy @ weight))


class Reflected(torch.autograd.Function):
    """Responses of unit lobes [n, p], diffuse and specular, differentiated by the operator's own `response`."""

    @staticmethod
    def forward(ctx, operator, roughness, log_sharpness, no, nz, oz):
        inputs = [t.detach().to(operator.dtype) for t in (roughness, log_sharpness.exp(), no, nz, oz)]
        response = operator.response(*inputs)
        r = {name: getattr(response, name).to(nz.dtype) for name in response.__struct_fields__}
        slopes = ("specular_by_roughness", "diffuse_by_log_sharpness", "specular_by_log_sharpness", "diffuse_by_nz", "specular_by_nz")
        ctx.save_for_backward(*(r[name] for name in (*slopes, "specular_by_oz")))
        return r["diffuse"], r["specular"]

    @staticmethod
    def backward(ctx, diffuse, specular):
        by_roughness, matte_by_sharpness, glossy_by_sharpness, matte_by_nz, glossy_by_nz, glossy_by_oz = ctx.saved_tensors
        by_sharpness = (diffuse * matte_by_sharpness + specular * glossy_by_sharpness).sum(0)
        by_nz = diffuse * matte_by_nz + specular * glossy_by_nz
        return None, (specular * by_roughness).sum(), by_sharpness, None, by_nz, specular * glossy_by_oz


def _variance(sums: Float[Tensor, "3"]) -> Tensor:
    """Variance over channels of the summed weights, in units of their squared mean."""
    return ((sums / sums.mean() - 1) ** 2).mean()


def _share(value, bounds):
    low, high = bounds
    return (np.asarray(value) - low) / (high - low)


def _logit(share):
    share = np.clip(share, 1e-4, 1 - 1e-4)
    return np.log(share / (1 - share))
