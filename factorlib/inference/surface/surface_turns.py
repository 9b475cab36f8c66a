"""Turns of normals that all photos of a mesh share, and one Gauss–Newton step of them with the lights eliminated.

Node v of a subdivided mesh (`meshes.subdivision`) has a turn δ_v, in the object's frame.  An observation whose pixel
shows the nodes v_1, v_2, v_3 with barycentric coordinates b_k has the normal

    n' = unit(n + P R Σ_k b_k δ_{v_k}),     R: light's frame from object's, P = 1 − n nᵀ                             (1)

A node may also have a log factor on the diffuse reflectance of each channel: patina, grain, dirt.  Both are unknowns x
of a node.

Let r be the residuals of one light, in σ, weighted by the robust loss and divided by √T.  Let J = ∂r/∂x, U = ∂r/∂u, and
H = UᵀU + Q_u the Hessian of that light with the gradient g.  Lights respond to a step dx by −H⁻¹(Uᵀ J dx + g).  With
them eliminated, the step minimises, up to a constant,

    Σ_lights [dxᵀ Jᵀ(1 − U H⁻¹ Uᵀ)J dx + 2 dxᵀ Jᵀ(r − U H⁻¹ g)]  +  a Σ_edges |x_i − x_j|² + b Σ_v |x_v|²           (2)

Lights must respond: given lights keep what they had absorbed of wrong normals, and normals stay wrong (measured: median
error 4.3° → 3.9° instead of 3.1°).  Conjugate gradients solve the system.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import block_diag, csr_array, eye_array, hstack, kron
from scipy.sparse.linalg import LinearOperator

from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster, face_normals
from factorlib.inference.fit.fit import Hyperparameters, light_likelihood
from factorlib.inference.fit.likelihood import cholesky_factor, cholesky_inverse
from factorlib.inference.model.blocks import FIT_LOSS, Block
from factorlib.inference.model.forward import Illumination
from factorlib.light.prior import LightPrior
from factorlib.meshes.subdivision import SubdividedMesh, solve_by_gradients
from factorlib.results.poses import ObjectPose
from factorlib.robust import TINY

LARGEST_TURN = 0.6  # largest |n' − n|: 35°
LEAST_VIEW_COSINE = 0.05  # least n'·o: a normal that would turn further stays as it is
PULL_SHARE = 0.06  # b/a, which fixes nodes without observations nearby
CG_TOLERANCE = 3e-3  # relative tolerance of conjugate gradients


class SurfacePositions(msgspec.Struct, frozen=True):
    """Positions of n observations on the surface.

    Attributes:
        node: Three nodes each, numbered over all meshes.
        share: Their barycentric coordinates; 0 if a pixel shows no mesh.
        frame: R of (1), with its sign changed where the surface is seen from behind.
    """

    node: Int[np.ndarray, "n 3"]
    share: Float[np.ndarray, "n 3"]
    frame: Float[np.ndarray, "n 3 3"]

    def take(self, rows: np.ndarray) -> SurfacePositions:
        """Return the observations `rows` alone."""
        return SurfacePositions(self.node[rows], self.share[rows], self.frame[rows])

    def rotate(self, rotation: Float[np.ndarray, "3 3"]) -> SurfacePositions:
        """Return the same positions for normals in another frame; `rotation` turns the present one into it."""
        return msgspec.structs.replace(self, frame=rotation @ self.frame)

    def operator(self, nodes: int) -> csr_array:
        """Return the matrix that maps all turns to R Σ_k b_k δ_{v_k}, [3n, 3v]."""
        values = self.share[:, None, :, None] * self.frame[:, :, None, :]  # observation, axis, node, its axis
        rows = (3 * np.arange(len(self.node))[:, None] + np.arange(3))[:, :, None, None]
        columns = (3 * self.node[:, :, None] + np.arange(3))[:, None]
        rows, columns = (np.broadcast_to(index, values.shape).reshape(-1) for index in (rows, columns))
        return csr_array((values.reshape(-1), (rows, columns)), (3 * len(self.node), 3 * nodes))

    def factor(self, log_factor: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the factor on the diffuse reflectance of each observation."""
        return np.exp(np.einsum("nk,nkc->nc", self.share, log_factor[self.node]))

    def turn_normals(
        self, normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "v 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the turned normals n' of (1), unit.

        |n' − n| is at most `LARGEST_TURN` before normalisation, and no normal turns away from the viewer.

        Args:
            normal: n, unit, in the light's frame.
            view: Unit vectors toward the viewer, in the light's frame.
            turn: δ at all nodes.
        """
        # P R Σ_k b_k δ_{v_k}, of (1)
        turned = np.einsum("nij,nkj,nk->ni", self.frame, turn[self.node], self.share)
        turned -= normal * np.sum(turned * normal, 1, keepdims=True)
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        turned = normal + turned * np.minimum(1, LARGEST_TURN / np.maximum(length, TINY))
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        return np.where(np.sum(turned * view, 1, keepdims=True) < LEAST_VIEW_COSINE, normal, turned)


def concatenate_positions(parts: Sequence[SurfacePositions]) -> SurfacePositions:
    """Return the observations of several parts, one after the other."""
    return SurfacePositions(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in SurfacePositions.__struct_fields__)
    )


class Surfaces(msgspec.Struct, frozen=True):
    """Subdivided meshes of a set by name, in the order of their nodes' numbers."""

    meshes: dict[str, SubdividedMesh]

    @property
    def first_nodes(self) -> dict[str, int]:
        """Index of each mesh's first node, by mesh name."""
        counts = [mesh.nodes for mesh in self.meshes.values()]
        return dict(zip(self.meshes, np.cumsum([0, *counts[:-1]]).tolist()))

    @property
    def nodes(self) -> int:
        """Number of the nodes of all meshes."""
        return sum(mesh.nodes for mesh in self.meshes.values())

    def laplacian(self) -> csr_array:
        """Return the Laplacian of all meshes, [v, v]."""
        return csr_array(block_diag([mesh.laplacian() for mesh in self.meshes.values()]))

    def displacements(
        self, turn: Float[np.ndarray, "v 3"], attached: Sequence[SurfacePositions]
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the displacements that best explain the turns of nodes, by mesh, in units of the mesh's extent.

        Nodes count by the observations attached to them (`SubdividedMesh.displacement`).
        """
        weight = sum(
            np.bincount(positions.node.reshape(-1), positions.share.reshape(-1), self.nodes) for positions in attached
        )
        turns = self.by_mesh(turn)
        observed = self.by_mesh(np.minimum(weight, 1.0))
        return {name: mesh.displacement(turns[name], observed[name]) for name, mesh in self.meshes.items()}

    def by_mesh(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Split values at all nodes by mesh."""
        return {name: values[k : k + self.meshes[name].nodes] for name, k in self.first_nodes.items()}

    def turns_from_displacements(self, displacements: dict[str, Float[np.ndarray, " n"]]) -> Float[np.ndarray, "v 3"]:
        """Return the turns that displacements imply; a mesh without a displacement has none."""
        zero = {name: np.zeros((mesh.nodes, 3)) for name, mesh in self.meshes.items()}
        turns = {name: self.meshes[name].normal_change(displacement) for name, displacement in displacements.items()}
        return np.vstack(list((zero | turns).values()))

    def node_mask(self, names: Iterable[str]) -> Bool[np.ndarray, " v"]:
        """Return a mask of the nodes of the meshes called `names`."""
        return np.concatenate([np.full(mesh.nodes, name in names) for name, mesh in self.meshes.items()])


def attach_pixels(
    pixels: Int[np.ndarray, "n 2"],
    object_number: Int[np.ndarray, " n"],
    camera: Camera,
    objects: Mapping[str, tuple[str, ObjectPose]],
    surfaces: Surfaces,
) -> SurfacePositions:
    """Return the positions on the surfaces that pixels (x, y) show, for normals in the camera's frame.

    Args:
        pixels: Integer pixel coordinates.
        object_number: Object in each pixel, numbered from 1 as in `align`; 0 for none.
        camera: Camera of the photo.
        objects: Mesh name and pose of each object, in the order of their numbers.
        surfaces: Subdivided meshes; objects with other meshes are not attached.
    """
    along = camera.rays_through(pixels + 0.5)
    count = len(pixels)
    node = np.zeros((count, 3), np.int64)
    share = np.zeros((count, 3))
    frame = np.zeros((count, 3, 3))
    for number, (mesh, entry) in enumerate(objects.values(), start=1):
        if mesh not in surfaces.meshes:
            continue
        rows = np.flatnonzero(object_number == number)
        fine = surfaces.meshes[mesh]
        # first hits of the pixels' rays, their triangles and barycentric coordinates
        hits = Caster(fine.mesh).cast_along(along[rows], entry.pose)
        rows = rows[hits.face >= 0]
        face = hits.face[hits.face >= 0]
        uv = hits.uv[hits.face >= 0]
        node[rows] = surfaces.first_nodes[mesh] + fine.faces[face]
        share[rows] = np.column_stack([1 - uv.sum(1), uv])
        # R of (1), with its sign changed where the surface is seen from behind
        toward = face_normals(fine.mesh, face) @ entry.pose.rotation.T
        side = np.where(np.sum(toward * along[rows], 1) > 0, -1.0, 1.0)
        frame[rows] = side[:, None, None] * entry.pose.rotation
    return SurfacePositions(node, share, frame)


class Detail(msgspec.Struct, frozen=True):
    """Detail of a surface beyond its mesh and materials, at v nodes.

    Attributes:
        turn: δ of the normals.
        log_factor: Logarithm of a factor on diffuse reflectance, per channel.
    """

    turn: Float[np.ndarray, "v 3"]
    log_factor: Float[np.ndarray, "v 3"]

    def apply_to(self, block: Block, attached: SurfacePositions) -> Block:
        """Return the block, which has no detail, with this detail."""
        normal = attached.turn_normals(block.normal, block.view, self.turn)
        return block.on_surface(normal, attached.factor(self.log_factor))


def zero_detail(nodes: int) -> Detail:
    """Return the detail of the mesh itself, all zero."""
    return Detail(np.zeros((nodes, 3)), np.zeros((nodes, 3)))


class LightTerms(msgspec.Struct, frozen=True, dict=True):
    """Terms of one light in (2).

    Attributes:
        slopes: J [3n, 6v], by turns and by log factors.
        residual: r.
        weight: Root of each residual's weight in the robust loss divided by T; 0 for those that do not count.
        temperature: T.
        by_light: U by channel: a channel's residuals depend on its own p cells, and on q exposures and tone exponents
            that all channels share.
        hessian: H.
        gradient: g.
        cells: p.
    """

    slopes: csr_array  # [3n, 6v], by turns and by log factors
    residual: Float[np.ndarray, " 3n"]
    weight: Float[np.ndarray, " 3n"]
    temperature: float
    by_light: Float[np.ndarray, "3 n p+q"]
    hessian: Float[np.ndarray, "l l"]
    gradient: Float[np.ndarray, " l"]
    cells: int

    @cached_property
    def covariance(self) -> Float[np.ndarray, "l l"]:
        """H⁻¹, the posterior covariance of the light."""
        return cholesky_inverse(cholesky_factor(self.hessian))

    @cached_property
    def unexplained(self) -> Float[np.ndarray, " 3n"]:
        """Residual r − U H⁻¹ g with the light at its own optimum."""
        return self.residual - self.residual_change(self.covariance @ self.gradient)

    def change(self, detail: Detail) -> float:
        """Return the change of φ by a detail, with the light at its own optimum in the linearised model.

        The loss is robust: where a highlight would move far, the linear model exaggerates the change.
        """
        change = self.slopes @ np.concatenate([detail.turn.reshape(-1), detail.log_factor.reshape(-1)])
        reduced = self.reduce_by_light(change)
        before = self.unexplained
        # the prior's part of (2), and that of the residuals by the robust loss
        prior = change @ (2 * before + reduced) - reduced @ (2 * before + reduced)
        losses = [
            FIT_LOSS.evaluate(r[self.weight > 0] / self.weight[self.weight > 0]) for r in (before, before + reduced)
        ]
        return float(prior + (losses[1] - losses[0]).sum() / self.temperature)

    def drop_observations(self, dropped: Bool[np.ndarray, " n"]) -> LightTerms:
        """Return the terms of the same light without the observations `dropped`."""
        remaining = np.repeat(~dropped, 3)
        hessian = self.hessian.copy()
        p = self.cells
        for c, U in enumerate(self.by_light[:, dropped].astype(float)):
            places = np.concatenate([np.arange(c * p, (c + 1) * p), np.arange(3 * p, len(hessian))])
            hessian[np.ix_(places, places)] -= U.T @ U
        gradient = self.gradient - self.light_gradient(np.where(remaining, 0.0, self.residual))
        slopes = self.slopes[np.flatnonzero(remaining)]
        residual, weight = self.residual[remaining], self.weight[remaining]
        by_light = self.by_light[:, ~dropped]
        return LightTerms(slopes, residual, weight, self.temperature, by_light, hessian, gradient, p)

    def residual_change(self, unknowns: Float[np.ndarray, " l"]) -> Float[np.ndarray, " 3n"]:
        """Return U du, the linearised change of the residuals by a change du of the light's unknowns."""
        cells = unknowns[: 3 * self.cells].reshape(3, -1)
        shared = unknowns[3 * self.cells :]
        changes = [U @ np.append(u, shared).astype(np.float32) for U, u in zip(self.by_light, cells, strict=True)]
        return np.stack(changes, axis=1).reshape(-1).astype(float)

    def light_gradient(self, change: Float[np.ndarray, " 3n"]) -> Float[np.ndarray, " l"]:
        """Return Uᵀ dr, the change of the light's gradient by a change dr of the residuals."""
        gradients = [U.T @ r.astype(np.float32) for U, r in zip(self.by_light, change.reshape(-1, 3).T, strict=True)]
        cells = [channel[: self.cells] for channel in gradients]
        return np.concatenate([*cells, np.sum([channel[self.cells :] for channel in gradients], axis=0)]).astype(float)

    def reduce_by_light(self, change: Float[np.ndarray, " 3n"]) -> Float[np.ndarray, " 3n"]:
        """Return (1 − U H⁻¹ Uᵀ) dr, the part of a change dr of the residuals that the light does not absorb."""
        return change - self.residual_change(self.covariance @ self.light_gradient(change))


def linearise_light(
    illumination: Illumination,
    hyperparameters: Hyperparameters,
    prior: LightPrior,
    attached: SurfacePositions,
    nodes: int,
) -> LightTerms:
    """Linearise one light at its block's normals and detail.

    Held-out observations have weight 0.

    Args:
        illumination: Observations and light.
        hyperparameters: Hyperparameters of the light.
        prior: Prior on the light.
        attached: Attachment of the block's observations.
        nodes: Number of all nodes.
    """
    likelihood = light_likelihood(illumination, hyperparameters, prior, materials_given=True)
    tabulated = likelihood.illumination
    n = len(illumination.block)
    p = int(tabulated.light.free.sum())
    prediction = tabulated.predict()
    residual = np.zeros((n, 3))
    by_light = np.zeros((3, n, tabulated.light.unknowns - 2 * p), np.float32)
    by_factor = np.zeros((n, 3))
    # r, ∂r/∂log k_d and U, row by row
    for line in tabulated.linearise(prediction, FIT_LOSS, hyperparameters.temperature):
        residual[line.rows, line.channel] = line.residual
        by_factor[line.rows, line.channel] = line.by_material[:, 0]  # ∂r/∂log k_d
        by_light[line.channel, line.rows] = np.hstack([line.diffuse + line.specular, line.by_photo])
    system = likelihood.normal_equations(determinants=False)
    whitened = illumination.block.residuals(prediction.radiance)
    weight = tabulated.root_weights(whitened, FIT_LOSS, hyperparameters.temperature)
    # J = [∂r/∂n R b, ∂r/∂log k_d b]
    slopes = (tabulated.by_normal() * weight[:, :, None]).reshape(3 * n, 3)
    factors = np.repeat(attached.share, 3, axis=0) * by_factor.reshape(-1, 1)
    columns = 3 * attached.node.repeat(3, axis=0) + np.tile(np.arange(3), n)[:, None]
    painted = csr_array((factors.reshape(-1), (np.arange(3 * n).repeat(3), columns.reshape(-1))), (3 * n, 3 * nodes))
    turning = csr_array(hstack([_block_diagonal(slopes) @ attached.operator(nodes), painted]))
    rows = residual.reshape(-1), weight.reshape(-1), hyperparameters.temperature
    return LightTerms(turning, *rows, by_light, system.light_hessian, system.light_gradient, p)


def _block_diagonal(slopes: Float[np.ndarray, "3n 3"]) -> csr_array:
    """Return the derivatives of three channels by three axes of their own observation as a sparse matrix, [3n, 3n]."""
    rows = np.arange(len(slopes))
    columns = 3 * (rows // 3)[:, None] + np.arange(3)
    return csr_array((slopes.reshape(-1), (np.repeat(rows, 3), columns.reshape(-1))), (len(slopes), len(slopes)))


class Stiffness(msgspec.Struct, frozen=True):
    """Stiffness a of (2); None keeps the quantity fixed.

    Attributes:
        turn: Stiffness of turns.
        factor: Stiffness of log factors.
    """

    turn: float | None
    factor: float | None = None


def solve_detail(
    parts: Sequence[LightTerms],
    laplacian: csr_array,
    stiffness: Stiffness,
    detail: Detail,
    movable: Bool[np.ndarray, " v"] | None = None,
) -> Detail:
    """Return the turns and log factors of all nodes that minimise (2).

    Args:
        parts: Linearised lights.
        laplacian: Laplacian of all meshes.
        stiffness: Stiffness of the detail.
        detail: Detail at which the parts were linearised.
        movable: Mask of the nodes whose normals may turn; None for all.
    """
    v = len(detail.log_factor)
    unknowns = np.concatenate([detail.turn.reshape(-1), detail.log_factor.reshape(-1)])
    roughness = csr_array(laplacian + PULL_SHARE * eye_array(v))
    # a L + b 1 for turns (three axes) and log factors (three channels), (2)
    prior = block_diag([kron((a or 0) * roughness, np.eye(3)) for a in (stiffness.turn, stiffness.factor)])
    turning = np.repeat(np.ones(v, bool) if movable is None else movable, 3) & (stiffness.turn is not None)
    free = np.append(turning, np.full(3 * v, stiffness.factor is not None))
    slopes = [part.slopes[:, free] for part in parts]
    prior = prior.tocsr()[free][:, free]
    # −gradient, and the diagonal of the Hessian for the Jacobi preconditioner
    target = -(prior @ unknowns[free])
    diagonal = prior.diagonal()
    for part, J in zip(parts, slopes, strict=True):
        target -= J.T @ part.unexplained
        diagonal = diagonal + J.multiply(J).sum(0)

    def system(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return the Hessian of (2) times a step."""
        return prior @ x + sum(J.T @ part.reduce_by_light(J @ x) for part, J in zip(parts, slopes, strict=True))

    size = 2 * (len(target),)
    unknowns[free] += solve_by_gradients(LinearOperator(size, system, dtype=float), target, diagonal, CG_TOLERANCE)
    return Detail(*unknowns.reshape(2, v, 3))
