"""Score test: gain of a further effect, predicted from a fit without it (Rao 1948).

Let ε_j ≥ 0 be sizes of effects, 0 in the fit: one over the distance of each light, or the share of the radiance that
surfaces send each other.  With s a step of all other unknowns, the objective (1) of `factorlib.inference.optimizer` is
to second order

    F(s, ε) = F + 2 gᵀs + sᵀH s + Σ_j (2 a_j ε_j + c_j ε_j² + 2 ε_j b_jᵀs).                                         (1)

Its minimum over s differs from that at ε = 0 by

    2 ãᵀε + εᵀC̃ ε,      ã_j = a_j − b_jᵀH⁻¹g,      C̃_jk = c_j δ_jk − b_jᵀH⁻¹b_k.                                   (2)

The predicted sizes minimise (2).  The predicted log Bayes factor of an effect is half of what its minimum rises without
the effect.  a, b and c follow from φ and its gradient at sizes 0, δ and 2δ.  So a test costs gradients, where a fit
costs factorisations.  Changes of log det H are neglected, and an effect of full size may be far from linear in ε: the
prediction says whether a fit is worth its cost, and the fit decides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from factorlib.inference.fit import Fit, light_likelihood, linearise_fit
from factorlib.inference.forward import Illumination
from factorlib.inference.likelihood import LightLikelihood
from factorlib.inference.problem import JointProblem
from factorlib.light.prior import LightPrior

Effect = Callable[[Illumination, float], Illumination]  # illumination with the effect of a size


class EffectTerms(NamedTuple):
    """Terms of (1) of one light: a, c, and b by materials and light."""

    slope: float
    curvature: float
    by_materials: Float[np.ndarray, " 7m"]
    by_light: Float[np.ndarray, " l"]


class Predicted(NamedTuple):
    """Predicted log Bayes factor of an effect, and its likeliest size ε."""

    log_bayes_factor: float
    size: float


class ScoreTest:
    """Score tests of effects at one fit.

    Args:
        problem: Observations and model of the fit.
        fit: Fit without the effects.
        prior: Prior on lights.
    """

    def __init__(self, problem: JointProblem, fit: Fit, prior: LightPrior):
        self.problem = problem.without_held_out()
        self.fit = fit
        self.prior = prior
        descent, self.state = linearise_fit(self.problem, fit, prior)
        by_determinant, _, self.arrow = descent.arrow(self.state)
        self.gradients = list(problem.spread(LightLikelihood.gradient, self.state.likelihoods))
        by_lights = sum(each.by_materials for each in self.gradients).reshape(-1)
        self.material_gradient = self.state.prior.gradient + by_determinant + by_lights
        self.newton = self.arrow.solve(self.material_gradient, [each.by_light for each in self.gradients])  # H⁻¹ g

    def of_each_light(self, effect: Effect, delta: float, most: float) -> list[Predicted]:
        """Return the prediction for the effect on each light.

        Args:
            effect: Effect.
            delta: δ.
            most: Largest ε.
        """
        return self.predict([{k: terms} for k, terms in self._terms(effect, delta).items()], most)

    def of_all_lights(self, effect: Effect, delta: float, most: float) -> Predicted:
        """Return the prediction for the effect on all lights, with one ε."""
        return self.predict([self._terms(effect, delta)], most)[0]

    def _terms(self, effect: Effect, delta: float) -> dict[int, EffectTerms]:
        """Return the terms of (1) by number of the light."""

        def of_light(k: int) -> EffectTerms:
            """Return the terms of one light."""
            illumination = self.state.likelihoods[k].illumination
            none = self.gradients[k]
            half, full = (
                light_likelihood(
                    effect(illumination, size), self.fit.hyperparameters[k], self.prior, tables=self.problem.tables
                ).gradient()
                for size in (delta, 2 * delta)
            )
            # φ(ε) = φ + 2 a ε + c ε²
            slope = (4 * half.value - full.value - 3 * none.value) / (4 * delta)
            curvature = (full.value - 2 * half.value + none.value) / (2 * delta**2)
            by_materials = (half.by_materials - none.by_materials).reshape(-1) / delta
            return EffectTerms(slope, curvature, by_materials, (half.by_light - none.by_light) / delta)

        numbers = range(len(self.gradients))
        return dict(zip(numbers, self.problem.spread(of_light, numbers), strict=True))

    def predict(self, effects: list[dict[int, EffectTerms]], most: float) -> list[Predicted]:
        """Return the predictions for effects of sizes 0 to `most`, given the terms of each by number of the light."""
        vectors = []  # b_j
        for terms in effects:
            by_materials = np.sum([each.by_materials for each in terms.values()], axis=0)
            lights = enumerate(self.gradients)
            by_lights = [terms[k].by_light if k in terms else np.zeros_like(each.by_light) for k, each in lights]
            vectors.append((by_materials, by_lights))
        solved = [self.arrow.solve(*vector) for vector in vectors]
        curvatures = np.diag([sum(each.curvature for each in terms.values()) for terms in effects])
        C = curvatures - [[_dot(vector, x) for x in solved] for vector in vectors]
        slopes = [sum(each.slope for each in terms.values()) for terms in effects]
        a = np.array(slopes) - [_dot(vector, self.newton) for vector in vectors]

        def minimum(limits: Float[np.ndarray, " j"]) -> tuple[float, Float[np.ndarray, " j"]]:
            """Return the minimum of (2) and ε there, with ε up to these limits."""
            found = minimize(
                lambda size: (float(size @ (2 * a + C @ size)), 2 * (a + C @ size)),
                np.zeros(len(a)), jac=True, method="L-BFGS-B", bounds=[(0.0, limit) for limit in limits],
            )  # fmt: skip
            return float(found.fun), found.x

        limits = np.full(len(a), most)
        lowest, sizes = minimum(limits)
        without = [minimum(np.where(np.arange(len(a)) == j, 0.0, limits))[0] for j in range(len(a))]
        return [Predicted((value - lowest) / 2, float(size)) for value, size in zip(without, sizes, strict=True)]


def _dot(a: tuple, b: tuple) -> float:
    """Return the scalar product of two vectors of materials and lights."""
    return float(a[0] @ b[0] + sum(float(x @ y) for x, y in zip(a[1], b[1], strict=True)))
