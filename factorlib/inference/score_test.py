"""Score test: gain of a further effect, predicted from a fit without it (Rao 1948).

Let ε_j ≥ 0 be the size of an effect on light j, 0 in the fit: one over its distance.  With s a step of all other
unknowns, the objective (1) of `factorlib.inference.optimizer` is to second order

    F(s, ε) = F + 2 gᵀs + sᵀH s + Σ_j (2 a_j ε_j + c_j ε_j² + 2 ε_j b_jᵀs).                                         (1)

Its minimum over s differs from that at ε = 0 by

    2 ãᵀε + εᵀC̃ ε,      ã_j = a_j − b_jᵀH⁻¹g,      C̃_jk = c_j δ_jk − b_jᵀH⁻¹b_k.                                   (2)

The predicted sizes minimise (2).  The predicted log Bayes factor of an effect is half of what its minimum rises without
the effect.  a, b and c follow from φ and its gradient at sizes 0, δ and 2δ.  So a test costs gradients, where a fit
costs factorisations.  Changes of log det H are neglected, and an effect of full size may be far from linear in ε: the
prediction says whether a fit is worth its cost, and the fit decides.  Of interreflection it is no guide: without it the
scale of reflectances is open, and the test dropped what a fit supports (made set of seed 102).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
        numbers = range(len(self.gradients))
        return self.predict(list(self.problem.spread(lambda k: self._terms(effect, delta, k), numbers)), most)

    def _terms(self, effect: Effect, delta: float, k: int) -> EffectTerms:
        """Return the terms of (1) of light k."""
        likelihood = self.state.likelihoods[k]
        none = self.gradients[k]
        hyperparameters = self.fit.hyperparameters[k]
        half, full = (
            light_likelihood(
                effect(likelihood.illumination, size), hyperparameters, self.prior, tables=self.problem.tables
            ).gradient()
            for size in (delta, 2 * delta)
        )
        # φ(ε) = φ + 2 a ε + c ε²
        slope = (4 * half.value - full.value - 3 * none.value) / (4 * delta)
        curvature = (full.value - 2 * half.value + none.value) / (2 * delta**2)
        by_materials = (half.by_materials - none.by_materials).reshape(-1) / delta
        return EffectTerms(slope, curvature, by_materials, (half.by_light - none.by_light) / delta)

    def predict(self, terms: Sequence[EffectTerms], most: float) -> list[Predicted]:
        """Return the predictions for an effect on each light, of sizes 0 to `most`."""
        nothing = [np.zeros_like(each.by_light) for each in terms]
        vectors = [(t.by_materials, [*nothing[:k], t.by_light, *nothing[k + 1 :]]) for k, t in enumerate(terms)]  # b_j
        solved = [self.arrow.solve(*vector) for vector in vectors]
        bends = np.array([[_dot(vector, x) for x in solved] for vector in vectors])
        C = np.diag([each.curvature for each in terms]) - bends
        a = np.array([each.slope - _dot(vector, self.newton) for each, vector in zip(terms, vectors, strict=True)])

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
