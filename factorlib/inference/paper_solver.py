"""Solver of the paper: limited-memory quasi-Newton steps on random subsets of the observations (arXiv 1710.08313).

    minimise  mean over observations and channels of (y − radiance)² / σ²  +  β · mean over lights of Var_c(W_c) / W̄²

y is the prediction of `factorlib.inference.model.forward`, σ its noise model, W_c the summed lobe weights of channel c,
and W̄ their mean.  Wang, Ritschel and Mitra state: L-BFGS; another random subset at every iteration; each observation
sampled 5 times on average; n_p = 32 lobes an illumination; β = 0.1.  This solver is the baseline of every comparison.

The paper leaves the following open, as far as it is known here:

Bounds       They come from the parametrisation: reflectances and roughness through a sigmoid, log sharpness through a
             sigmoid onto `SHARPNESS`, weights through softplus, axes as unnormalised vectors.
Start        Reflectances come from mean radiances (`start`).  Lobes are white, evenly spread over the sphere, and as
             wide as they are apart.
Subset       A subset has `SUBSET_SIZE` observations of all illuminations together.
Curvature    A pair (step, change of gradient) is measured on one subset, at both ends of the step.  The change of
             subset is therefore not mistaken for curvature (Schraudolph, Yu and Günter 2007, "A stochastic quasi-Newton
             method for online convex optimization").  Pairs outlive their subset.
Residuals    They are whitened by the noise model.  With plain differences the subsets' highlights dominate: on three
             materials in two known lights the held-out loss stayed ten times as high.
Step         It is halved until it lowers the objective enough (Armijo).  No unknown moves by more than `LARGEST_STEP`:
             longer steps drive the sigmoids to where their slopes vanish.
Clipping     A clipped channel is a lower bound, as in the joint solver: it pulls from below only.
Exposures    Exposures of further photos that share a light are unknowns of their own.

The solver does not model self-shadowing, interreflection, outliers, or the number of lobes that a light needs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.fit.fit import initial_fit
from factorlib.inference.fit.fit_runner import Event, EventReport, Solution, ignore_event
from factorlib.inference.fit.optimizer import inverse_hessian_times
from factorlib.inference.fit.start import starting_materials
from factorlib.inference.model.gauge import fix_gauge
from factorlib.inference.model.lights import Light
from factorlib.inference.model.materials import ROUGHNESS, SHARPNESS, UNKNOWNS, Materials, Point
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import Lobes, Seed, SolveOptions
from factorlib.light.prior import read_light_prior
from factorlib.reflection.operator import Operator

Objective = Callable[[Tensor], tuple[float, Tensor]]  # value and gradient at a point
Pairs = deque[tuple[Tensor, Tensor]]  # steps, and changes of gradient along them

MEMORY = 20  # pairs of L-BFGS
LARGEST_STEP = 0.05  # largest change of an unknown in one step
SUFFICIENT = 1e-4  # least decrease in a line search, as a share of the slope
LOBE_UNKNOWNS = 3 + 1 + 3  # of a lobe: axis, sharpness, weight
HALVINGS = 12  # most halvings of a step
LOG_SHARPNESS = (math.log(SHARPNESS[0]), math.log(SHARPNESS[1]))
REPORTS = 20  # reports in a run
SUBSET_SIZE = 512  # observations of a subset

Samplings = Annotated[float, msgspec.Meta(gt=0)]
Prior = Annotated[float, msgspec.Meta(ge=0)]


class PaperOptions(msgspec.Struct, frozen=True):
    """Options of the paper's solver.

    Attributes:
        lobes: Number of lobes of an illumination.
        samplings: Average number of times that each observation is sampled in the run.
        prior: β.
        seed: Seed of the random subsets.
    """

    lobes: Lobes = 32
    samplings: Samplings = 5.0
    prior: Prior = 0.1
    seed: Seed = 0


def solve_paper(
    problem: JointProblem, materials: int, options: PaperOptions, report: EventReport = ignore_event
) -> Solution:
    """Solve the problem as the paper does, in the gauge of `factorlib.inference.model.gauge`.

    The unknowns are those of the joint solver: materials 0 … `materials`−1 and one light per block.

    Args:
        problem: Observations and model; shadows, interreflection and backgrounds are ignored.
        materials: Number of materials.
        options: Options.
        report: Called with each reported subset.
    """
    problem = problem.with_effects(False, False).keep_backgrounds([])
    objective = PaperObjective(problem, materials, options)
    history = list[Event]()
    blocks = problem.blocks
    rows = [np.flatnonzero(~block.held_out) for block in blocks]
    iterations = math.ceil(options.samplings * sum(map(len, rows)) / SUBSET_SIZE)
    report_interval = max(1, iterations // REPORTS)
    lobes = options.lobes * len(blocks)
    x = objective.start()
    random = np.random.default_rng(options.seed)
    pairs: Pairs = deque(maxlen=MEMORY)
    for iteration in range(iterations):
        subset = draw_subset(rows, SUBSET_SIZE, random)
        x, value = take_step(partial(objective.objective_on, subset=subset), x, pairs)
        if (iteration + 1) % report_interval == 0 or iteration + 1 == iterations:
            held_out = problem.held_out_loss(objective.point(x))
            history.append(Event((iteration + 1) // report_interval - 1, "subset", iteration, value, held_out, lobes))
            report(history[-1])
    fit = initial_fit(objective.point(x))
    point = fix_gauge(fit.point, blocks)
    observations = SolveOptions().observations
    return Solution(fit, fit, observations=observations, point=point, history=history, prior=read_light_prior())


def draw_subset(
    rows: Sequence[Int[np.ndarray, " _"]], count: int, random: np.random.Generator
) -> list[Int[np.ndarray, " _"]]:
    """Return `count` of all rows, drawn without replacement, as a list per block."""
    starts = np.cumsum([0, *map(len, rows)])
    drawn_rows = np.sort(random.choice(starts[-1], min(count, starts[-1]), replace=False))
    return [
        block_rows[drawn_rows[(drawn_rows >= a) & (drawn_rows < b)] - a]
        for block_rows, a, b in zip(rows, starts[:-1], starts[1:], strict=True)
    ]


def take_step(objective: Objective, x: Tensor, pairs: Pairs) -> tuple[Tensor, float]:
    """Return x after one step on one subset, and the objective there.

    The measured pair is added to `pairs`.  Without a sufficient decrease, x stays and `pairs` is cleared.
    """
    value, gradient = objective(x)
    direction = -inverse_hessian_times(gradient, pairs, lambda slope: first_metric(slope, pairs))
    direction = direction * min(1.0, LARGEST_STEP / max(float(direction.abs().max()), 1e-30))
    slope = float(gradient @ direction)
    length = 1.0
    for _ in range(HALVINGS):
        trial = x + length * direction
        trial_value, trial_gradient = objective(trial)
        if trial_value <= value + SUFFICIENT * length * slope:
            # both gradients are of the same subset
            step = trial - x
            change = trial_gradient - gradient
            if float(step @ change) > 1e-8 * float(step.norm() * change.norm()):
                pairs.append((step, change))
            return trial, trial_value
        length /= 2
    pairs.clear()
    return x, value


def first_metric(slope: Tensor, pairs: Pairs) -> Tensor:
    """Return a gradient times the initial inverse Hessian of L-BFGS, a number from the last pair.

    Without a pair, the product is scaled to a largest entry of 0.1.
    """
    if not pairs:
        return 0.1 * slope / max(float(slope.abs().max()), 1e-30)
    step, change = pairs[-1]
    return slope * (float(step @ change) / float(change @ change))


class PaperObjective:
    """Objective as a function of one unbounded vector, float64.

    The vector has 7 entries a material, then for each light 7 a lobe (axis 3, sharpness, weight 3) and its exposures.
    """

    def __init__(self, problem: JointProblem, materials: int, options: PaperOptions):
        self.blocks = problem.blocks
        self.operator = problem.operator
        self.options = options
        self.start_materials = starting_materials(problem.blocks, materials)
        self.sizes = [UNKNOWNS * materials] + [
            LOBE_UNKNOWNS * options.lobes + len(block.photos) - 1 for block in problem.blocks
        ]

    def start(self) -> Float[Tensor, " k"]:
        """Return even lobes under which materials reflect the block's mean radiance, 1."""
        p = self.options.lobes
        materials = self.start_materials
        roughness = _unbounded(materials.roughness, ROUGHNESS)
        parts = [
            np.column_stack([_unbounded(materials.diffuse), _unbounded(materials.specular), roughness]).reshape(-1)
        ]
        level = np.full((p, 1), _unbounded(np.log(p / 2), LOG_SHARPNESS))  # λ of lobes whose variances cover 4π
        for block in self.blocks:
            reflectance = (materials.diffuse + materials.specular)[block.material].mean(0)
            weight = np.tile(block.radiance.mean(0) / np.maximum(reflectance, 1e-3), (p, 1))
            lobes = np.hstack([fibonacci_sphere(p), level, np.log(np.expm1(weight))])
            parts += [lobes.reshape(-1), np.zeros(len(block.photos) - 1)]
        return torch.from_numpy(np.concatenate(parts))

    def unpack(self, x: Tensor) -> tuple[tuple[Tensor, ...], list[tuple[Tensor, ...]]]:
        """Return (diffuse, specular, roughness) and, of each light, (axis, log sharpness, weight, log exposure)."""
        material_part, *light_parts = torch.split(x, self.sizes)
        bounded = torch.sigmoid(material_part.reshape(-1, UNKNOWNS))
        (low, high) = ROUGHNESS
        (least, most) = LOG_SHARPNESS
        lights: list[tuple[Tensor, ...]] = []
        for part in light_parts:
            rows = part[: LOBE_UNKNOWNS * self.options.lobes].reshape(-1, LOBE_UNKNOWNS)
            log_exposures = part[LOBE_UNKNOWNS * self.options.lobes :]
            axis = torch.nn.functional.normalize(rows[:, :3], dim=1)
            log_sharpness = least + (most - least) * torch.sigmoid(rows[:, 3])
            weight = torch.nn.functional.softplus(rows[:, 4:])
            lights.append((axis, log_sharpness, weight, torch.cat([part.new_zeros(1), log_exposures])))
        return (bounded[:, :3], bounded[:, 3:6], low + (high - low) * bounded[:, 6]), lights

    def point(self, x: Tensor) -> Point:
        """Return the materials and lights that the vector x of unknowns encodes."""
        (diffuse, specular, roughness), lights = self.unpack(x)
        vector = torch.cat([diffuse, specular, roughness[:, None]], 1).reshape(-1).numpy()
        arrays = [[part.numpy() for part in light] for light in lights]
        light_list = [Light(axis, sharpness, weight, exposure) for axis, sharpness, weight, exposure in arrays]
        return Point(Materials.from_vector(vector), light_list)

    def objective_on(self, x: Tensor, subset: Sequence[Int[np.ndarray, " _"]]) -> tuple[float, Tensor]:
        """Return the value and the gradient on the subset."""
        x = x.detach().requires_grad_()
        (diffuse, specular, roughness), lights = self.unpack(x)
        squares = x.new_zeros(())
        values = 0
        prior = x.new_zeros(())
        for block, (axis, log_sharpness, weight, log_exposure), rows in zip(self.blocks, lights, subset, strict=True):
            sums = weight.sum(0)
            prior = prior + ((sums / sums.mean() - 1) ** 2).mean()  # Var_c(W_c) / W̄²
            for m in np.unique(block.material[rows]).tolist():
                selected = rows[block.material[rows] == m]
                normal, view, photo, radiance, inverse_sigma, clipped = (
                    torch.from_numpy(column[selected])
                    for column in (
                        block.normal,
                        block.view,
                        block.photo,
                        block.radiance,
                        block.inverse_sigma,
                        block.clipped,
                    )
                )
                cosines = (normal * view).sum(1), normal @ axis.T, view @ axis.T  # n·o, n·z and o·z
                # y = e (k_d D w + k_s S w), one-sided where clipped
                responses = UnitReflection.apply(self.operator, roughness[m], log_sharpness, *cosines)
                by_diffuse, by_specular = (part @ weight for part in responses)
                exposure = torch.exp(log_exposure)[photo][:, None]
                predicted = exposure * (diffuse[m] * by_diffuse + specular[m] * by_specular)
                difference = (predicted - radiance) * inverse_sigma
                squares = squares + (difference.masked_fill(clipped & (difference > 0), 0.0) ** 2).sum()
                values += difference.numel()
        value = squares / max(values, 1) + self.options.prior * prior / len(self.blocks)
        (gradient,) = torch.autograd.grad(value, x)
        return float(value.detach()), gradient


class UnitReflection(torch.autograd.Function):
    """Differentiable responses D and S [n, p] without shadows, with the derivatives of the operator's `response`."""

    @staticmethod
    def forward(
        ctx: Any,
        operator: Operator,
        roughness: Tensor,
        log_sharpness: Tensor,
        *cosines: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the responses D and S from the cosines n·o [n], n·z and o·z [n, p]."""
        inputs = [t.detach().to(operator.dtype) for t in (roughness, log_sharpness.exp(), *cosines)]
        r = operator.response(*inputs)
        slopes = (
            *(r.specular_by_roughness, r.diffuse_by_log_sharpness, r.specular_by_log_sharpness),
            *(r.diffuse_by_nz, r.specular_by_nz, r.specular_by_oz),
        )
        ctx.save_for_backward(*(slope.to(cosines[1].dtype) for slope in slopes))
        return r.diffuse.to(cosines[1].dtype), r.specular.to(cosines[1].dtype)

    @staticmethod
    def backward(ctx: Any, diffuse: Tensor, specular: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients with respect to roughness, log sharpness, n·z and o·z; n·o is constant."""
        by_roughness, d_by_sharpness, s_by_sharpness, d_by_nz, s_by_nz, s_by_oz = ctx.saved_tensors
        by_sharpness = (diffuse * d_by_sharpness + specular * s_by_sharpness).sum(0)
        by_nz = diffuse * d_by_nz + specular * s_by_nz
        return None, (specular * by_roughness).sum(), by_sharpness, None, by_nz, specular * s_by_oz


def _unbounded(value: Float[np.ndarray, "*n"], bounds: tuple[float, float] = (0.0, 1.0)) -> Float[np.ndarray, "*n"]:
    """Return the inverse of a sigmoid onto the bounds, for values kept off their ends."""
    low, high = bounds
    share = np.clip((value - low) / (high - low), 1e-4, 1 - 1e-4)
    return np.log(share / (1 - share))
