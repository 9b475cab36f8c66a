"""Optimiser of the marginal likelihood: few factorisations, and many cheap steps on each.

The objective is minus twice the log marginal likelihood plus the prior on materials,

    F(u, θ) = φ(u; θ) + log det H(u; θ) + prior(θ),                                                                 (1)

with lights u at the minimum of φ.  For a light of p cells and n observations, a gradient of φ costs n p and H costs n
p².  The factor of H and the derivatives of its determinant cost p³.  H is therefore factorised once, at (u₀, θ₀).
L-BFGS (Nocedal 1980) with H⁻¹ as its initial inverse Hessian then minimises

    φ(u; θ) + prior(θ) + 2 aᵀ(θ − θ₀) + (θ − θ₀)ᵀ(D + μ diag)(θ − θ₀),     a = ½ (∂/∂θ + (du/dθ)ᵀ ∂/∂u) log det H    (2)

Its gradient is exact except for the determinant, which lags behind.  The minimum is accepted if it lowers (1).
Otherwise the damping μ grows and the same factor serves again.  At a fixed point the gradient of (2) is that of (1), up
to what `factorlib.inference.fit.likelihood` takes as constant in the determinant.  Lights move to the minimum of φ
alone: with the determinant in their objective, the approximation would not be Laplace's.

Given the materials, each light minimises φ by itself, in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve

from factorlib.inference.fit.likelihood import LightLikelihood, System, solve_cholesky
from factorlib.inference.model.lights import TONE_RANGE, Light
from factorlib.inference.model.material_prior import MaterialPrior, PriorTerms, materials_from_unknowns
from factorlib.inference.model.materials import LEAST_REFLECTANCE, REFLECTANCES, ROUGHNESS, UNKNOWNS
from factorlib.inference.model.problem import Spread
from factorlib.results.materials import FitStatus
from factorlib.robust import TINY

FLOOR = 1e-9  # share of the largest diagonal entry that is added to every diagonal entry
LARGEST_CHANGE = np.array([0.7] * REFLECTANCES + [0.1])  # largest change of a material's unknowns on one factorisation
LARGEST_STEP = 1.5  # largest change of an unknown in one cheap step
LEAST_SLOPE_SHARE = 0.1  # least share of the slope that a clipped direction must keep
LOWER_BOUNDS = np.array([np.log(LEAST_REFLECTANCE)] * REFLECTANCES + [ROUGHNESS[0]])
UPPER_BOUNDS = np.array([np.inf] * REFLECTANCES + [ROUGHNESS[1]])
FIRST_DAMPING = 0.1  # μ after the first rejected step
DAMPING_DECREASE = 0.25  # factor on μ after an accepted step
DAMPING_INCREASE = 8.0  # factor on μ after a rejected step
LARGEST_DAMPING = 1e3  # a descent ends beyond this μ
TOLERANCE = 2e-4  # a descent ends if (1) falls by less than this share of its value
MEMORY = 10  # pairs of L-BFGS
LBFGS_STEPS = 12  # most steps of L-BFGS on one factorisation
# L-BFGS ends if gᵀH⁻¹g, the predicted decrease, falls below DECREMENT or below DECREMENT_SHARE of its first value.
DECREMENT = 0.05
DECREMENT_SHARE = 0.02
SUFFICIENT = 1e-4  # least decrease in a line search, as a share of the slope
SHORTEST = 1e-3  # a line search ends below this share of the step

Vector = Float[np.ndarray, " k"]
LossReport = Callable[[float], None]  # called at every factorisation, with the mean robust loss there
Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]  # value and half the gradient


class Arrow:
    """Factorised H of many lights; H⁻¹ of a vector costs two triangular solves a light.

    H = [[M, C_1 … C_k], [C_iᵀ, L_i]] has arrow shape: each light is coupled to the materials it illuminates, and to no
    other light.  With g = (g_m, g_i), the product x = H⁻¹ g follows by elimination of every light:

        (M − Σ C_i L_i⁻¹ C_iᵀ) x_m = g_m − Σ C_i L_i⁻¹ g_i,      x_i = L_i⁻¹ (g_i − C_iᵀ x_m)                       (3)

    C_i has rows only for the materials that light i illuminates.  Rows and columns of known unknowns and of unknowns
    at a bound are removed.  Damping multiplies the diagonal, so that a step does not depend on the units of an unknown.

    Args:
        systems: Contribution of each light.
        prior: Half the Hessian of the prior on materials.
        free: Mask of the material unknowns that may move.
        damping: Multiple of the materials' diagonal that is added to it.
    """

    def __init__(
        self,
        systems: Sequence[System],
        prior: Float[np.ndarray, "k k"],
        free: Bool[np.ndarray, " k"],
        damping: float = 0.0,
    ):
        self.systems = systems
        self.free = np.flatnonzero(free)
        self.coupling = [solve_cholesky(part.factor, part.cross_hessian.T) for part in systems]  # L⁻¹Cᵀ
        # M − Σ C_i L_i⁻¹ C_iᵀ, (3), damped
        schur = prior.copy()
        self.diagonal = np.zeros(len(prior))
        for part, coupling in zip(systems, self.coupling, strict=True):
            schur[np.ix_(part.places, part.places)] += part.material_hessian - part.cross_hessian @ coupling
            self.diagonal[part.places] += np.diag(part.material_hessian)
        self.diagonal += np.diag(prior)
        schur += np.diag(damping * self.diagonal + FLOOR * self.diagonal.max(initial=1e-30))
        self.schur = cho_factor(((schur + schur.T) / 2)[np.ix_(self.free, self.free)], check_finite=False)

    def solve(self, by_materials: Vector, by_lights: Sequence[Vector]) -> tuple[Vector, list[Vector]]:
        """Return H⁻¹ g, the solution of the normal equations, by (3)."""
        # L_i⁻¹ g_i, then dm by the Schur complement, then L_i⁻¹ (g_i − C_iᵀ dm)
        light_steps = [solve_cholesky(part.factor, g) for part, g in zip(self.systems, by_lights, strict=True)]
        reduced = by_materials.copy()
        step = np.zeros_like(by_materials)
        for part, light_step in zip(self.systems, light_steps, strict=True):
            reduced[part.places] -= part.cross_hessian @ light_step
        step[self.free] = cho_solve(self.schur, reduced[self.free], check_finite=False)
        lights = zip(self.systems, light_steps, self.coupling, strict=True)
        return step, [light_step - coupling @ step[part.places] for part, light_step, coupling in lights]


class DescentState(NamedTuple):
    """Unknowns of the materials and lights, and the normal equations there.

    Attributes:
        theta: log k_d, log k_s and roughness of m materials.
        likelihoods: Likelihood of each light.
        value: Objective.
        systems: Normal equations of each light.
        prior: Prior on the materials.
    """

    theta: Float[np.ndarray, "m 7"]
    likelihoods: list[LightLikelihood]
    value: float
    systems: list[System]
    prior: PriorTerms


class Descent(msgspec.Struct, frozen=True):
    """Descent under a prior on materials.

    Attributes:
        prior: Prior on materials.
        spread: Map over lights.
        report: Called at every factorisation.
        free: Mask of the material unknowns to be estimated.
    """

    prior: MaterialPrior
    spread: Spread
    report: LossReport
    free: Bool[np.ndarray, " 7m"]

    def descend_lights(
        self, likelihoods: Sequence[LightLikelihood], theta: Float[np.ndarray, "m 7"], iterations: int
    ) -> tuple[DescentState, list[FitStatus]]:
        """Descend each light by itself with the materials fixed; return the state, and the status of each light.

        A light gets at most `iterations` minimisations by L-BFGS, each preconditioned by one factorisation of H.
        """
        fits = list(self.spread(lambda likelihood: descend_light(likelihood, iterations), likelihoods))
        fitted, systems, statuses = (list(parts) for parts in zip(*fits, strict=True))
        return self._state(theta, fitted, systems), statuses

    def descend_jointly(self, state: DescentState, iterations: int) -> tuple[DescentState, FitStatus]:
        """Return the state after at most `iterations` steps of materials and lights together, and the status.

        Each step costs one factorisation, also a rejected one.
        """
        damping = 0.0
        start = state
        for number in range(1, iterations + 1):
            trial = self.linearise(*self._step(state, damping))
            gain = state.value - trial.value
            if gain > 0:
                state = trial
                damping = damping * DAMPING_DECREASE
            if abs(gain) < TOLERANCE * abs(state.value):
                return state, FitStatus("converged", number)
            if damping > LARGEST_DAMPING:
                return state, FitStatus("failed", number)
            if gain < 0:
                damping = max(damping * DAMPING_INCREASE, FIRST_DAMPING)
        return state, FitStatus("failed" if state is start and iterations else "limit", iterations)

    def linearise(self, likelihoods: Sequence[LightLikelihood], theta: Float[np.ndarray, "m 7"]) -> DescentState:
        """Return the normal equations of all lights at some materials, determinants included."""
        materials = materials_from_unknowns(theta)
        moved = [likelihood.with_point(materials=materials) for likelihood in likelihoods]
        return self._state(theta, moved, list(self.spread(LightLikelihood.normal_equations, moved)))

    def _state(
        self, theta: Float[np.ndarray, "m 7"], likelihoods: list[LightLikelihood], systems: list[System]
    ) -> DescentState:
        """Return the state with these systems, and report its mean robust loss."""
        prior = self.prior.evaluate(theta)
        values = sum(3 * int((~likelihood.illumination.block.held_out).sum()) for likelihood in likelihoods)
        self.report(sum(system.loss for system in systems) / max(values, 1))
        return DescentState(theta, likelihoods, sum(system.value for system in systems) + prior.value, systems, prior)

    def _step(self, state: DescentState, damping: float) -> tuple[list[LightLikelihood], Float[np.ndarray, "m 7"]]:
        """Return lights and materials at the minimum of (2)."""
        size = state.theta.size
        by_determinant, hessian = determinant_terms(state.systems, size)
        # half the gradient of (1) by materials; unknowns at a limit that it would push beyond it are fixed
        gradient = state.prior.gradient + by_determinant
        for system in state.systems:
            gradient[system.places] += system.material_gradient
        limits = [material_limits(state.theta, self.free), *(light_limits(each.light) for each in state.likelihoods)]
        free = np.where(gradient > 0, limits[0][0] < 0, limits[0][1] > 0)
        # H with D and the damping μ
        arrow = Arrow(state.systems, state.prior.hessian + hessian, free, damping)
        penalty = hessian + damping * np.diag(arrow.diagonal)
        ends = np.cumsum([size, *(len(system.light_gradient) for system in state.systems)])[:-1]

        def apply_step(step: np.ndarray) -> tuple[np.ndarray, list[LightLikelihood]]:
            """Return θ and the lights after a step of all unknowns."""
            material_step, *light_steps = np.split(step, ends)
            theta = (state.theta + material_step.reshape(-1, UNKNOWNS)).clip(LOWER_BOUNDS, UPPER_BOUNDS)
            materials = materials_from_unknowns(theta)
            steps = zip(state.likelihoods, light_steps, strict=True)
            return theta, [old.with_point(step_light(old.light, step), materials) for old, step in steps]

        def objective(step: np.ndarray) -> tuple[float, np.ndarray]:
            """Return (2) and half its gradient."""
            theta, likelihoods = apply_step(step)
            prior = self.prior.evaluate(theta)
            parts = list(self.spread(LightLikelihood.gradient, likelihoods))
            off = (theta - state.theta).reshape(-1)
            value = prior.value + sum(part.value for part in parts) + off @ (2 * by_determinant + penalty @ off)
            slope = prior.gradient + by_determinant + penalty @ off
            slope = slope + sum(part.by_materials for part in parts).reshape(-1)
            return value, np.concatenate([slope, *(part.by_light for part in parts)])

        def metric(slope: np.ndarray) -> np.ndarray:
            """Return H⁻¹ times a gradient."""
            material_slope, *light_slopes = np.split(slope, ends)
            step, lights = arrow.solve(material_slope, light_slopes)
            return np.concatenate([step, *lights])

        theta, likelihoods = apply_step(minimise_lbfgs(objective, np.hstack(limits), metric))
        return likelihoods, theta


def material_limits(theta: Float[np.ndarray, "m 7"], free: Bool[np.ndarray, " k"]) -> Float[np.ndarray, "2 k"]:
    """Return lower and upper limits of a step of the material unknowns; those that are not `free` do not move."""
    change = free.reshape(-1, UNKNOWNS) * LARGEST_CHANGE
    limits = np.maximum(-change, LOWER_BOUNDS - theta), np.minimum(change, UPPER_BOUNDS - theta)
    return np.reshape(limits, (2, theta.size))


def descend_light(likelihood: LightLikelihood, iterations: int) -> tuple[LightLikelihood, System, FitStatus]:
    """Minimise φ over one light with the materials fixed.

    The result is its likelihood and normal equations at the minimum, and the status.

    There are at most `iterations` minimisations by L-BFGS, each preconditioned by one factorisation of H.
    """
    system = likelihood.normal_equations(determinants=False)
    for number in range(1, iterations + 1):

        def objective(step: np.ndarray, start: LightLikelihood = likelihood) -> tuple[float, np.ndarray]:
            """Return φ and half its gradient."""
            gradient = start.with_point(step_light(start.light, step)).gradient()
            return gradient.value, gradient.by_light

        def metric(slope: np.ndarray, factor: np.ndarray = system.factor) -> np.ndarray:
            """Return H⁻¹ times a gradient."""
            return solve_cholesky(factor, slope)

        step = minimise_lbfgs(objective, light_limits(likelihood.light), metric)
        likelihood = likelihood.with_point(step_light(likelihood.light, step))
        previous = system.value
        system = likelihood.normal_equations(determinants=False)
        if previous - system.value < TOLERANCE * abs(previous):
            return likelihood, system, FitStatus("converged", number)
    return likelihood, system, FitStatus("limit", iterations)


def determinant_terms(systems: Sequence[System], size: int) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Return a and D of (2), the derivatives of the determinants of all lights."""
    gradient = np.zeros(size)
    hessian = np.zeros((size, size))
    for system in systems:
        # (du/dθ)ᵀ ∂/∂u = −C L⁻¹ ∂/∂u, exposures included
        by_light = system.cross_hessian @ solve_cholesky(system.factor, system.determinant_by_light)
        gradient[system.places] += system.determinant_by_materials - by_light
        P = gauge_projection(system.places)
        hessian[np.ix_(system.places, system.places)] += P @ system.determinant_hessian @ P
    return gradient, hessian


def gauge_projection(places: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k k"]:
    """Return the projection that removes a factor per channel from a step of the materials of a light.

    J and the determinant do not change if all reflectances are multiplied by a factor and the light is divided by it.
    """
    unknown = places[:, None] % UNKNOWNS
    factors = (unknown == np.arange(3)) | (unknown == np.arange(3, 6))
    return np.eye(len(places)) - factors / factors.sum(0) @ factors.T


def minimise_lbfgs(
    objective: Objective, limits: Float[np.ndarray, "2 n"], metric: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, " n"]:
    """Minimise a function within limits by projected L-BFGS and return the step from 0.

    Unknowns at a limit that the gradient would push beyond it do not take part in a step.

    Args:
        objective: Function that returns the value and half the gradient.
        limits: Lower and upper limits of the unknowns, about 0.
        metric: Product of a vector with the approximate inverse of half the Hessian.
    """
    lower, upper = limits
    x = np.zeros(len(lower))
    value, gradient = objective(x)
    pairs: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=MEMORY)
    least = 0.0
    for _ in range(LBFGS_STEPS):
        free = np.where(gradient > 0, x > lower, x < upper)
        direction = free * -inverse_hessian_times(free * gradient, pairs, metric)
        decrement = -float(gradient @ direction)
        least = least or max(DECREMENT, DECREMENT_SHARE * decrement)
        if decrement < least:
            break
        direction = clip_direction(direction, gradient)
        slope = float(gradient @ direction)
        length = 1.0
        # backtracking line search (Armijo); the gradient is half the true one
        while length > SHORTEST:
            trial = (x + length * direction).clip(lower, upper)
            trial_value, trial_gradient = objective(trial)
            if trial_value <= value + 2 * SUFFICIENT * min(float(gradient @ (trial - x)), 0.0):
                break
            # minimum of the parabola through both values and the slope
            length *= float(np.clip(-slope * length / max(trial_value - value - 2 * slope * length, TINY), 0.1, 0.5))
        else:
            break
        if (change := trial_gradient - gradient) @ (trial - x) > 0:
            pairs.append((trial - x, change))
        x = trial
        value = trial_value
        gradient = trial_gradient
    return x


def clip_direction(direction: Float[np.ndarray, " n"], gradient: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return a direction with no element larger than `LARGEST_STEP`.

    Each element is clipped by itself, because otherwise a dark cell would limit all others.  If clipping turns the
    direction uphill or nearly so, the whole direction is scaled instead.
    """
    clipped = direction.clip(-LARGEST_STEP, LARGEST_STEP)
    if gradient @ clipped < LEAST_SLOPE_SHARE * (gradient @ direction):
        return clipped
    return direction * min(1.0, LARGEST_STEP / float(np.abs(direction).max()))


def inverse_hessian_times(gradient, pairs, metric):  # noqa: ANN001, ANN201  (arrays or tensors)
    """Return the product of L-BFGS's inverse Hessian with a gradient, by the two-loop recursion (Nocedal 1980).

    Args:
        gradient: Gradient, an array or a tensor.
        pairs: Steps, and changes of the gradient along them.
        metric: Product of the initial inverse Hessian with a vector.
    """
    q = gradient
    alphas = []
    for step, change in reversed(pairs):
        alphas.append(float(step @ q) / float(step @ change))
        q = q - alphas[-1] * change
    q = metric(q)
    for (step, change), alpha in zip(pairs, reversed(alphas), strict=True):
        q = q + (alpha - float(change @ q) / float(step @ change)) * step
    return q


def light_limits(light: Light) -> Float[np.ndarray, "2 l"]:
    """Return lower and upper limits of a step of a light's unknowns: tone exponents stay within their range."""
    limits = np.tile([[-np.inf], [np.inf]], light.unknowns)
    first = light.integrated + light.free_exposures
    limits[:, first : first + len(light.log_tone)] = np.log(TONE_RANGE)[:, None] - light.log_tone
    return limits


def step_light(light: Light, step: Float[np.ndarray, " l"]) -> Light:
    """Return the light after a step of its unknowns."""
    counts = 3 * int(light.free.sum()), len(light.turns), light.free_exposures, len(light.log_tone)
    cells, turns, exposures, tones, scale = np.split(step, np.cumsum(counts))
    brighter = np.ones((len(light), 3))
    brighter[light.free] = np.exp(cells.reshape(3, -1).T)
    brighter[~light.free] = np.exp(scale.sum())
    exposures = np.concatenate([np.zeros(len(light.log_exposure) - len(exposures)), exposures])
    return msgspec.structs.replace(
        light,
        weight=light.weight * brighter,
        turns=light.turns + turns,
        log_exposure=light.log_exposure + exposures,
        log_tone=light.log_tone + tones,
    )
