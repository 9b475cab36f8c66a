"""Turns of normals that all photos of a mesh share, and one Gauss–Newton step of them with the lights eliminated.

Node v of a subdivided mesh (`meshes.subdivision`) has a turn δ_v, in the object's frame.  An observation whose pixel
shows the nodes v_1, v_2, v_3 with barycentric coordinates b_k has the normal

    n' = unit(n + P R Σ_k b_k δ_{v_k}),     R: light's frame from object's, P = 1 − n nᵀ                             (1)

A node may also have a log factor on the diffuse reflectance: patina, grain, dirt.  Both are unknowns x of a node.

Let r be the residuals of one light, in σ, weighted by the robust loss and divided by √T.  Let J = ∂r/∂x, U = ∂r/∂u, and
H = UᵀU + Q_u the Hessian of that light with the gradient g.  The light's response to a step dx changes r by −U H⁻¹(Uᵀ J
dx + g).  The step minimises the remaining residual plus a prior:

    Σ_lights ‖(1 − U H⁻¹ Uᵀ)(r + J dx)‖²  +  a Σ_edges |x_i − x_j|² + b Σ_v |x_v|²                                   (2)

Lights must respond: given lights keep what they had absorbed of wrong normals, and normals stay wrong (measured: median
error 4.3° → 3.9° instead of 3.1°).  ∂r/∂n is a finite difference of the forward model along two tangents.  Conjugate
gradients solve the system.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import block_diag, csr_array, diags_array, eye_array, hstack, kron
from scipy.sparse.linalg import LinearOperator, cg

from factorlib.inference.blocks import Block
from factorlib.inference.fit import ROBUST, Hyperparameters, likelihood_of
from factorlib.inference.forward import Illumination
from factorlib.light.prior import LightPrior

STEP = 0.02  # step of a normal for finite differences: about 1°
MOST = 0.6  # largest |n' − n|: 35°
GRAZING = 0.05  # least n'·o: a normal that would turn further stays as it is
PULL = 0.06  # b/a, which fixes nodes without observations nearby
ACCURACY = 3e-3  # relative tolerance of conjugate gradients
ITERATIONS = 150  # most iterations of conjugate gradients


class Attached(msgspec.Struct, frozen=True):
    """Positions of n observations on the surface.

    Attributes:
        node: Three nodes each, numbered over all meshes.
        share: Their barycentric coordinates; 0 if a pixel shows no mesh.
        frame: R of (1), with its sign changed where the surface is seen from behind.
    """

    node: Int[np.ndarray, "n 3"]
    share: Float[np.ndarray, "n 3"]
    frame: Float[np.ndarray, "n 3 3"]

    def take(self, rows: np.ndarray) -> Attached:
        """Return the observations `rows` alone."""
        return Attached(self.node[rows], self.share[rows], self.frame[rows])

    def in_frame(self, rotation: Float[np.ndarray, "3 3"]) -> Attached:
        """Return the same positions for normals in another frame; `rotation` turns the present one into it."""
        return msgspec.structs.replace(self, frame=rotation @ self.frame)

    def operator(self, nodes: int) -> csr_array:
        """Return the matrix that maps all turns to R Σ_k b_k δ_{v_k}, [3n, 3v]."""
        values = self.share[:, None, :, None] * self.frame[:, :, None, :]  # observation, axis, node, its axis
        rows = (3 * np.arange(len(self.node))[:, None] + np.arange(3))[:, :, None, None]
        columns = (3 * self.node[:, :, None] + np.arange(3))[:, None]
        rows, columns = (np.broadcast_to(of, values.shape).reshape(-1) for of in (rows, columns))
        return csr_array((values.reshape(-1), (rows, columns)), (3 * len(self.node), 3 * nodes))

    def factor(self, log_factor: Float[np.ndarray, " v"]) -> Float[np.ndarray, " n"]:
        """Return the factors on diffuse reflectance."""
        return np.exp(np.sum(self.share * log_factor[self.node], axis=1))

    def turned(
        self, normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "v 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return n' of (1), unit.

        |n' − n| is at most `MOST` before normalisation, and no normal turns away from the viewer.

        Args:
            normal: n, unit, in the light's frame.
            view: Unit vectors toward the viewer, in the light's frame.
            turn: δ at all nodes.
        """
        # P R Σ_k b_k δ_{v_k}, of (1)
        moved = np.einsum("nij,nkj,nk->ni", self.frame, turn[self.node], self.share)
        moved -= normal * np.sum(moved * normal, 1, keepdims=True)
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        moved = normal + moved * np.minimum(1, MOST / np.maximum(length, 1e-12))
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        return np.where(np.sum(moved * view, 1, keepdims=True) < GRAZING, normal, moved)


def joined(parts: Sequence[Attached]) -> Attached:
    """Return the observations of several parts, one after the other."""
    return Attached(*(np.concatenate([getattr(part, name) for part in parts]) for name in Attached.__struct_fields__))


class Detail(msgspec.Struct, frozen=True):
    """Detail of a surface beyond its mesh and materials, at v nodes.

    Attributes:
        turn: δ of the normals.
        log_factor: Logarithm of a factor on diffuse reflectance.
    """

    turn: Float[np.ndarray, "v 3"]
    log_factor: Float[np.ndarray, " v"]

    def on(self, block: Block, attached: Attached) -> Block:
        """Return the block, which has no detail, with this detail."""
        normal = attached.turned(block.normal, block.view, self.turn)
        return block.on_surface(normal, attached.factor(self.log_factor))


def no_detail(nodes: int) -> Detail:
    """Return the detail of the mesh itself, all zero."""
    return Detail(np.zeros((nodes, 3)), np.zeros(nodes))


class Part(msgspec.Struct, frozen=True, dict=True):
    """Terms of one light in (2).

    Attributes:
        slopes: J [3n, 4v], by turns and by log factors.
        residual: r.
        by_light: U by channel: a channel's residuals depend on its own p cells, and on q exposures and tone exponents
            that all channels share.
        hessian: H.
        gradient: g.
        cells: p.
    """

    slopes: csr_array  # [3n, 4v], by turns and by log factors
    residual: Float[np.ndarray, " 3n"]
    by_light: Float[np.ndarray, "3 n p+q"]
    hessian: Float[np.ndarray, "l l"]
    gradient: Float[np.ndarray, " l"]
    cells: int

    @cached_property
    def factor(self) -> tuple[np.ndarray, bool]:
        """Cholesky factor of H."""
        return cho_factor(self.hessian)

    @property
    def unexplained(self) -> Float[np.ndarray, " 3n"]:
        """Residual r − U H⁻¹ g with the light at its own optimum."""
        return self.residual - self.of_light(cho_solve(self.factor, self.gradient))

    def without(self, gone: Bool[np.ndarray, " n"]) -> Part:
        """Return the terms of the same light without the observations `gone`."""
        rest = np.repeat(~gone, 3)
        hessian = self.hessian.copy()
        p = self.cells
        for c, U in enumerate(self.by_light[:, gone].astype(float)):
            places = np.concatenate([np.arange(c * p, (c + 1) * p), np.arange(3 * p, len(hessian))])
            hessian[np.ix_(places, places)] -= U.T @ U
        gradient = self.gradient - self.to_light(np.where(rest, 0.0, self.residual))
        slopes = self.slopes[np.flatnonzero(rest)]
        return Part(slopes, self.residual[rest], self.by_light[:, ~gone], hessian, gradient, p)

    def of_light(self, unknowns: Float[np.ndarray, " l"]) -> Float[np.ndarray, " 3n"]:
        """Return U times a change of the light."""
        own = unknowns[: 3 * self.cells].reshape(3, -1)
        shared = unknowns[3 * self.cells :]
        each = [U @ np.append(u, shared).astype(np.float32) for U, u in zip(self.by_light, own, strict=True)]
        return np.stack(each, axis=1).reshape(-1).astype(float)

    def to_light(self, change: Float[np.ndarray, " 3n"]) -> Float[np.ndarray, " l"]:
        """Return Uᵀ times a change of the residuals."""
        each = [U.T @ r.astype(np.float32) for U, r in zip(self.by_light, change.reshape(-1, 3).T, strict=True)]
        own = [of[: self.cells] for of in each]
        return np.concatenate([*own, np.sum([of[self.cells :] for of in each], axis=0)]).astype(float)

    def without_light(self, change: Float[np.ndarray, " 3n"]) -> Float[np.ndarray, " 3n"]:
        """Return (1 − U H⁻¹ Uᵀ) times a change of the residuals."""
        return change - self.of_light(cho_solve(self.factor, self.to_light(change)))


def part_of(
    illumination: Illumination, counts: Hyperparameters, prior: LightPrior, attached: Attached, nodes: int
) -> Part:
    """Linearise one light at its block's normals and detail.

    Held-out observations have weight 0.

    Args:
        illumination: Observations and light.
        counts: Hyperparameters of the light.
        prior: Prior on the light.
        attached: Attachment of the block's observations.
        nodes: Number of all nodes.
    """
    likelihood = likelihood_of(illumination, counts, prior, materials_given=True)
    own = likelihood.illumination
    block = illumination.block
    n = len(block)
    p = len(own.light)
    shown = own.shown()
    residual = np.zeros((n, 3))
    by_light = np.zeros((3, n, own.light.unknowns - 2 * p), np.float32)
    by_factor = np.zeros((n, 3))
    # r, ∂r/∂log k_d and U, row by row
    for line in own.linearise(shown, ROBUST, counts.temperature):
        residual[line.rows, line.channel] = line.residual
        by_factor[line.rows, line.channel] = line.by_material[:, 0]  # ∂r/∂log k_d
        by_light[line.channel, line.rows] = np.hstack([line.diffuse + line.specular, line.by_photo])
    system = likelihood.normal_equations(materials_given=True)
    weight = own.pull(block.residuals(shown.radiance), ROBUST, counts.temperature)
    # J = [∂r/∂n R b, ∂r/∂log k_d b]
    slopes = (_by_normal(illumination) * weight[:, :, None]).reshape(3 * n, 3)
    factors = np.repeat(attached.share, 3, axis=0) * by_factor.reshape(-1, 1)
    rows = (np.arange(3 * n).repeat(3), attached.node.repeat(3, axis=0).reshape(-1))
    painted = csr_array((factors.reshape(-1), rows), (3 * n, nodes))
    turning = csr_array(hstack([_rows(slopes) @ attached.operator(nodes), painted]))
    return Part(turning, residual.reshape(-1), by_light, system.light_hessian, system.light_gradient, p)


def _rows(slopes: Float[np.ndarray, "3n 3"]) -> csr_array:
    """Return the derivatives of three channels by three axes of their own observation as a sparse matrix, [3n, 3n]."""
    rows = np.arange(len(slopes))
    columns = 3 * (rows // 3)[:, None] + np.arange(3)
    return csr_array((slopes.reshape(-1), (np.repeat(rows, 3), columns.reshape(-1))), (len(slopes), len(slopes)))


def _by_normal(illumination: Illumination) -> Float[np.ndarray, "n 3 3"]:
    """Return ∂r/∂n of each observation, channel by axis, in the tangent plane of the normal."""
    block = illumination.block
    normal = block.normal
    before = illumination.residuals()
    # two tangents, and finite differences of the residuals along each
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    result = np.zeros((len(block), 3, 3))
    for tangent in (first, np.cross(normal, first)):
        moved = normal + STEP * tangent
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        after = msgspec.structs.replace(illumination, block=msgspec.structs.replace(block, normal=moved)).residuals()
        result += ((after - before) / STEP)[:, :, None] * tangent[:, None, :]
    return result


class Stiffness(msgspec.Struct, frozen=True):
    """Stiffness a of (2); None keeps the quantity fixed.

    Attributes:
        turn: Stiffness of turns.
        factor: Stiffness of log factors.
    """

    turn: float | None
    factor: float | None = None


def step(
    parts: Sequence[Part],
    laplacian: csr_array,
    stiffness: Stiffness,
    at: Detail,
    moving: Bool[np.ndarray, " v"] | None = None,
) -> Detail:
    """Return the detail that minimises (2).

    Args:
        parts: Linearised lights.
        laplacian: Laplacian of all meshes.
        stiffness: Stiffness of the detail.
        at: Detail at which the parts were linearised.
        moving: Mask of the nodes whose normals may turn; None for all.
    """
    v = len(at.log_factor)
    both = np.concatenate([at.turn.reshape(-1), at.log_factor])
    roughness = csr_array(laplacian + PULL * eye_array(v))
    # a L + b 1 for turns (three axes) and log factors, (2)
    prior = block_diag([kron((stiffness.turn or 0) * roughness, np.eye(3)), (stiffness.factor or 0) * roughness])
    turning = np.repeat(np.ones(v, bool) if moving is None else moving, 3) & (stiffness.turn is not None)
    free = np.append(turning, np.full(v, stiffness.factor is not None))
    slopes = [part.slopes[:, free] for part in parts]
    prior = prior.tocsr()[free][:, free]
    # −gradient, and the diagonal of the Hessian for the Jacobi preconditioner
    right = -(prior @ both[free])
    diagonal = prior.diagonal()
    for part, J in zip(parts, slopes, strict=True):
        right -= J.T @ part.unexplained
        diagonal = diagonal + J.multiply(J).sum(0)

    def system(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return the Hessian of (2) times a step."""
        return prior @ x + sum(J.T @ part.without_light(J @ x) for part, J in zip(parts, slopes, strict=True))

    size = 2 * (len(right),)
    preconditioner = diags_array(1 / diagonal)
    found, _ = cg(LinearOperator(size, system, dtype=float), right, rtol=ACCURACY, maxiter=ITERATIONS, M=preconditioner)
    both[free] += found
    return Detail(both[: 3 * v].reshape(-1, 3), both[3 * v :])
