"""Errors of normals: turns of whole objects, which observations share, and independent errors of single normals.

Normals that are wrong by δn change the predicted radiance by ∂y/∂n · δn: much in a highlight or where light changes
fast, little in soft light.  Both kinds are integrated out to first order (Kaipio and Somersalo 2007, "Statistical
inverse problems: discretization, model reduction and inverse crimes").  Derivatives are those at the materials and the
light with which a step of the solve begins, so that all models that are compared weigh observations alike.

Alone   A normal of confidence c (`factorlib.align.reliability`) is wrong by δn ~ N(0, s²) along each tangent.  The
        variance of a channel becomes

            σ'² = σ² + s² |∂y/∂n|²,        s² = DEVIATION² (1/c² − 1).                                               (1)

        s is the error beyond that of a sure normal, which σ covers.  Merged observations share the error of their
        normal, which no number of them averages out.

Poses   An object whose pose is wrong turns all its normals together.  Its light absorbs such an error, so that
        residuals do not show it.  The turn about each axis of each object in each photo is therefore an unknown η of
        the light, in units of POSE_DEVIATION, with the prior N(0, v):

            y = y₀ + (∂y/∂η) η,        ∂y/∂η = POSE_DEVIATION · ∂y/∂n (axis × n).                                   (2)

        It is fitted and integrated out with the light (`factorlib.inference.fit.likelihood`).  v, one for all lights,
        is estimated with T (`factorlib.inference.fit.fit`), from 1 on.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.inference.model.blocks import Block
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.materials import Point
from factorlib.inference.model.problem import JointProblem
from factorlib.robust import TINY

# Standard deviation of a normal along a tangent, radians, times its confidence.  On data/eames, whose true normals are
# known, the RMS along a tangent is 1.0, 1.3, 2.6, 7.4 and 13 degrees where 1/c degrees are 1.1, 1.3, 1.7, 6.0 and 17
# (`studies.measured.normals`).
DEVIATION = np.radians(1.0)
# RMS error of an estimated pose about an axis, radians: 0.57 degrees on data/eames, 0.58 and 0.43 on two similar sets
# (`studies.measured.normals`).
POSE_DEVIATION = np.radians(0.6)


def normal_variance(block: Block) -> Float[np.ndarray, " n"]:
    """Return the variance of each observation's normal along a tangent, that of a sure one included; 0 if all are."""
    return np.zeros(len(block)) if block.confidence is None else (DEVIATION / block.confidence) ** 2


class NormalErrors(msgspec.Struct, frozen=True):
    """Errors of the normals of one light's n observations.

    Attributes:
        weight: σ/σ' of (1), a factor on 1/σ.
        by_turns: ∂y/∂η of (2), channel by turn, in the block's unit.
    """

    weight: Float[np.ndarray, "n 3"]
    by_turns: Float[np.ndarray, "n 3 q"]

    def apply_to(self, block: Block) -> Block:
        """Return the same observations, which have no errors of normals yet, with these errors."""
        weighted = block.inverse_sigma * self.weight
        return msgspec.structs.replace(block, inverse_sigma=weighted, by_turns=self.by_turns)


def with_normal_errors(problem: JointProblem, point: Point) -> JointProblem:
    """Return the problem whose normals have the errors (1) and (2), with the derivatives at a point."""
    return apply_errors(problem, normal_errors(problem, point))


def apply_errors(problem: JointProblem, errors: Sequence[NormalErrors]) -> JointProblem:
    """Return the problem with these errors of each light's observations."""
    return problem.with_blocks([each.apply_to(block) for block, each in zip(problem.blocks, errors, strict=True)])


def normal_errors(problem: JointProblem, point: Point) -> list[NormalErrors]:
    """Return the errors of normals of every light's observations, with the derivatives at a point."""
    return list(problem.spread(_errors, problem.illuminations(point)))


def weighed_by_confidence(problem: JointProblem) -> JointProblem:
    """Return the problem whose observations have the share c of their weight, and not the errors (1) and (2)."""
    blocks = []
    for block in problem.blocks:
        share = 1.0 if block.confidence is None else np.sqrt(block.confidence)[:, None]
        blocks.append(msgspec.structs.replace(block, inverse_sigma=block.inverse_sigma * share))
    return problem.with_blocks(blocks)


def _errors(illumination: Illumination) -> NormalErrors:
    """Return the errors of the normals of one light's observations; none without confidences."""
    block = illumination.block
    n = len(block)
    if block.confidence is None:
        return NormalErrors(np.ones((n, 3)), np.zeros((n, 3, 0)))
    slopes = illumination.by_normal()
    # σ/σ' of (1)
    alone = normal_variance(block)[:, None] - DEVIATION**2
    weight = 1 / np.sqrt(1 + np.square(slopes).sum(2) * alone)
    # ∂y/∂η of (2): a column for each axis of each object in each photo
    axes = np.stack([np.cross(axis, block.normal) for axis in np.eye(3)], axis=2)
    by_axis = POSE_DEVIATION * (slopes @ axes) / np.maximum(block.inverse_sigma, TINY)[:, :, None]
    number = np.zeros(n, int) if block.object is None else block.object
    pose = np.unique(np.column_stack([block.photo, number]), axis=0, return_inverse=True)[1].reshape(-1)
    is_pose = pose[:, None] == np.arange(pose.max(initial=-1) + 1)
    by_turns = by_axis[:, :, None, :] * is_pose[:, None, :, None]
    return NormalErrors(weight, by_turns.reshape(n, 3, -1))
