"""Variance of an observation by the error of its normal.

A normal that is wrong by δn changes the predicted radiance by ∂y/∂n · δn: much in a highlight or where light changes
fast, little in soft light.  With δn ~ N(0, s²) along each tangent, integrated out to first order (Kaipio and Somersalo
2007, "Statistical inverse problems: discretization, model reduction and inverse crimes"), the variance of a channel
becomes

    σ'² = σ² + s² |∂y/∂n|²,        s² = DEVIATION² (1/c² − 1),                                                     (1)

with the confidence c of the normal (`factorlib.align.reliability`).  s is the error beyond that of a sure normal, which
σ covers.  The derivative is that at the materials and the light with which a step of the solve begins, so that all
models that are compared weigh observations alike.  Merged observations share the error of their normal, which no number
of them averages out.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.inference.blocks import Block
from factorlib.inference.forward import Illumination
from factorlib.inference.materials import Point
from factorlib.inference.problem import JointProblem

# Standard deviation of a normal along a tangent, radians, times its confidence.  On data/eames, whose true normals are
# known, the RMS along a tangent is 1.0, 1.3, 2.6, 7.4 and 13 degrees where 1/c degrees are 1.1, 1.3, 1.7, 6.0 and 17
# (`studies.measured.normals`).
DEVIATION = np.radians(1.0)


def normal_deviation(block: Block) -> Float[np.ndarray, " n"]:
    """Return s of (1), radians, of each observation's normal; 0 without confidences."""
    if block.confidence is None:
        return np.zeros(len(block))
    return DEVIATION * np.sqrt(np.maximum(block.confidence**-2.0 - 1, 0))


def with_normal_errors(problem: JointProblem, point: Point) -> JointProblem:
    """Return the problem whose observations have the variance (1), with the derivatives at a point."""
    return scale_weights(problem, normal_error_factors(problem, point))


def normal_error_factors(problem: JointProblem, point: Point) -> list[Float[np.ndarray, "n 3"]]:
    """Return σ/σ' of (1) of every light's observations, with the derivatives at a point."""
    return list(problem.spread(_factors, problem.illuminations(point)))


def scale_weights(problem: JointProblem, factors: Sequence[Float[np.ndarray, "n c"]]) -> JointProblem:
    """Return the problem with 1/σ of every light's observations multiplied by these factors."""
    pairs = zip(problem.blocks, factors, strict=True)
    return problem.with_blocks([msgspec.structs.replace(b, inverse_sigma=b.inverse_sigma * f) for b, f in pairs])


def weighed_by_confidence(problem: JointProblem) -> JointProblem:
    """Return the problem whose observations have the share c of their weight, and not the variance (1)."""
    ones = np.ones((1, 1))
    factors = [ones if b.confidence is None else np.sqrt(b.confidence)[:, None] for b in problem.blocks]
    return scale_weights(problem, factors)


def _factors(illumination: Illumination) -> Float[np.ndarray, "n 3"]:
    """Return σ/σ' of (1) of one light's observations."""
    block = illumination.block
    if block.confidence is None:
        return np.ones_like(block.inverse_sigma)
    slope = np.linalg.norm(illumination.by_normal(), axis=2)
    return 1 / np.hypot(1, slope * normal_deviation(block)[:, None])
