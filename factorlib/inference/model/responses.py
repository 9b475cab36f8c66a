"""Responses of observations to lobes of weight one: the reflection operator evaluated for the rows of a block.

    D_ip → v_ip D_ip   diffuse response of observation i to lobe p, for k_d = 1
    S_ip → u_ip S_ip   specular response, for k_s = 1

v and u are the shares of each lobe's reflection that shadows
leave: (1) and (2) of `factorlib.light.visibility`, and 1 without visibility.

The cells of a light stay in place during a descent, so responses depend on materials through their roughness alone.
`ResponseTable` computes them at the `NODES` when they are first needed.  It interpolates between nodes by cubic
polynomials of log roughness.  The peak of a sharp cell's highlight falls with roughness⁻⁴.  Between nodes a factor h
apart, the interpolation error is (9/384)(4 ln h)⁴ of the peak at worst: 0.17 % for the nodes' factor 1.136.  Cells no
sharper than `COARSE_SHARPNESS` blur highlights, and every second node is enough.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache
from hashlib import blake2b
from math import prod
from threading import Lock
from typing import NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.inference.model.blocks import Block
from factorlib.inference.model.lights import UnitLobes
from factorlib.light.distance import finite_distance_cosines
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, visible_share
from factorlib.reflection.operator import Operator

CHUNK = 4096  # observations whose responses are computed at once
SHADOW_ROWS = 512  # observations whose visibility a processor's cache holds
NODES = np.geomspace(0.1, 1.0, 19)  # roughness of the nodes
COARSE_SHARPNESS = 200.0  # λ up to which every second node is enough
DEGREE = 3  # of the polynomials between nodes
CACHED_NODES = 6  # nodes of a material whose responses stay in memory
CACHED_TABLES = 16  # tables that stay in memory, about 400 MB
Rows = slice | Int[np.ndarray, " n"]


def diffuse_response(block: Block, rows: Rows, lobes: UnitLobes, operator: Operator) -> Float[np.ndarray, "n p"]:
    """Return the diffuse responses D of the observations `rows` to lobes of weight one, float64.

    Args:
        block: Observations.
        rows: Selected observations.
        lobes: Lobes of weight one.
        operator: Reflection operator.
    """
    nz, _, larger = lobe_cosines(block, rows, lobes)
    with torch.no_grad():
        response = operator.diffuse(_tensor(lobes.sharpness, operator), _tensor(nz, operator))
        return larger * apply_shadows(response, block, rows, lobes).double().numpy()


def specular_response(
    block: Block, rows: Rows, lobes: UnitLobes, roughness: float, operator: Operator
) -> Float[np.ndarray, "n p"]:
    """Return the specular responses S of the observations `rows`, of one roughness, to lobes of weight one, float64.

    Args:
        block: Observations.
        rows: Selected observations, all of that material.
        lobes: Lobes of weight one.
        roughness: Roughness of the material.
        operator: Reflection operator.
    """
    nz, oz, larger = lobe_cosines(block, rows, lobes)
    no = (block.normal[rows] * block.view[rows]).sum(1)
    inputs = (_tensor(v, operator) for v in (np.array(roughness), lobes.sharpness, no, nz, oz))
    with torch.no_grad():
        return larger * apply_shadows(operator.specular(*inputs), block, rows, lobes, roughness).double().numpy()


def lobe_cosines(block: Block, rows: Rows, lobes: UnitLobes) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
    """Return the cosines n·z', o·z' and weights w'/w of (1) of `factorlib.light.distance`, [n, p].

    Shadows do not use them: for visibility the light is infinitely far away.

    Args:
        block: Observations.
        rows: Selected observations.
        lobes: Lobes with their curvature.
    """
    normal = block.normal[rows]
    view = block.view[rows]
    if lobes.curvature == 0 or block.place is None:
        return normal @ lobes.axis.T, view @ lobes.axis.T, 1.0
    return finite_distance_cosines(block.place[rows], normal, view, lobes.axis, lobes.curvature)


def _tensor(values: np.ndarray, operator: Operator) -> Tensor:
    """Return values as a tensor of the operator's type."""
    return torch.as_tensor(values).to(operator.dtype)


def apply_shadows(
    response: Float[Tensor, "n p"], block: Block, rows: Rows, lobes: UnitLobes, roughness: float | None = None
) -> Float[Tensor, "n p"]:
    """Return the response at `rows` with shadows.

    Args:
        response: Response without shadows.
        block: Observations.
        rows: Selected observations.
        lobes: Lobes of weight one.
        roughness: Roughness of the material for the specular response; None for the diffuse one.
    """
    if block.visibility is None or block.directions is None:
        return response
    response = response.clone()
    visibility = block.visibility[rows]
    photo = block.photo[rows]
    hidden = (visibility < 255).any(1)
    axis, sharpness, normal, view = (
        torch.from_numpy(v).float() for v in (lobes.axis, lobes.sharpness, block.normal[rows], block.view[rows])
    )
    for k in np.unique(photo[hidden]):
        directions = torch.from_numpy(block.directions[k]).float()
        shadowed = np.flatnonzero(hidden & (photo == k))
        lobe_values = kernel(directions, axis, sharpness)
        # v of (1) or u of (2) of factorlib.light.visibility, for as many observations as fit in the cache
        for chunk in np.split(shadowed, range(SHADOW_ROWS, len(shadowed), SHADOW_ROWS)):
            weights = (
                cosine_weights(normal[chunk], directions)
                if roughness is None
                else highlight_weights(normal[chunk], view[chunk], directions, float(roughness))
            )
            share = visible_share(torch.from_numpy(visibility[chunk]).float() / 255, weights, lobe_values)
            response[chunk] *= share.to(response.dtype)
    return response


class Responses(NamedTuple):
    """Responses of n observations of one material to p lobes of weight one.

    Attributes:
        stack: D, then S at each of k nodes of roughness, float32.
        share: Weights of the k nodes in S.
        slope: Weights of the k nodes in ∂S/∂roughness.
    """

    stack: Float[np.ndarray, "k+1 n p"]
    share: Float[np.ndarray, " k"]
    slope: Float[np.ndarray, " k"]

    @property
    def diffuse(self) -> Float[np.ndarray, "n p"]:
        """Diffuse response D."""
        return self.stack[0]

    @property
    def specular(self) -> Float[np.ndarray, "n p"]:
        """Specular response S."""
        return self._interpolate(self.share)

    @property
    def by_roughness(self) -> Float[np.ndarray, "n p"]:
        """Derivative of the specular response, ∂S/∂roughness."""
        return self._interpolate(self.slope)

    def _interpolate(self, weights: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n p"]:
        """Return the weighted sum over nodes."""
        return np.tensordot(weights.astype(np.float32), self.stack[1:], axes=1)

    def radiance(self, weight: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "3 n 3"]:
        """Return the responses to lobes of weights w: D w, S w and (∂S/∂roughness) w, without forming S."""
        nodes, n, p = self.stack.shape
        sums = (self.stack.reshape(-1, p) @ weight.astype(np.float32)).reshape(nodes, 3 * n).astype(float)
        return np.stack([sums[0], self.share @ sums[1:], self.slope @ sums[1:]]).reshape(3, n, 3)

    def by_weight(
        self, by_diffuse: Float[np.ndarray, "n 3"], by_specular: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "p 3"]:
        """Return Dᵀ a + Sᵀ b, the gradient by weights of a value with the gradient a by D w and b by S w."""
        slopes = np.concatenate([by_diffuse[None], self.share[:, None, None] * by_specular]).astype(np.float32)
        return (self.stack.reshape(-1, self.stack.shape[2]).T @ slopes.reshape(-1, 3)).astype(float)


class ResponseLookup(Protocol):
    """Responses of a block, material by material."""

    def rows(self, m: int) -> slice:
        """Return the rows of material m."""
        ...

    def interpolate(self, m: int, roughness: float) -> Responses:
        """Return the responses of material m at a roughness."""
        ...


class ResponseTable:
    """Responses of a block's observations to some lobes, material by material, float32; values at nodes are kept.

    Args:
        block: Observations.
        lobes: Lobes of weight one.
        operator: Reflection operator.
        materials_given: True if roughness does not change.  It is then the only node, and ∂S/∂roughness is zero,
            because nothing uses it.
    """

    def __init__(self, block: Block, lobes: UnitLobes, operator: Operator, materials_given: bool = False):
        self.block = block
        self.operator = operator
        self.lobes = lobes
        self.materials_given = materials_given
        self.nodes = NODES[::2] if lobes.sharpness.max(initial=0) <= COARSE_SHARPNESS else NODES
        self._diffuse: dict[int, np.ndarray] = {}  # by material
        self._specular: dict[int, dict[int, np.ndarray]] = {}  # by material and node
        self._stacks: dict[int, tuple[int, np.ndarray]] = {}  # by material: the first node, and the stack from there on

    def rows(self, m: int) -> slice:
        """Return the rows of material m, which are contiguous."""
        start, stop = np.searchsorted(self.block.material, [m, m + 1])
        return slice(int(start), int(stop))

    def interpolate(self, m: int, roughness: float) -> Responses:
        """Return the responses of material m at a roughness."""
        if self.materials_given:
            if m not in self._stacks:
                self._stacks[m] = 0, np.stack([self._diffuse_of(m), self._evaluate(m, roughness)])
            return Responses(self._stacks[m][1], np.ones(1), np.zeros(1))
        # cubic interpolation between the four nearest nodes, in log roughness
        start = int(np.clip(np.searchsorted(self.nodes, roughness) - 2, 0, len(self.nodes) - DEGREE - 1))
        nodes = self.nodes[start : start + DEGREE + 1]
        share, slope = lagrange_weights(tuple(np.log(nodes).tolist()), float(np.log(roughness)))
        if self._stacks.get(m, (None,))[0] != start:
            known = [self._specular_at_node(m, start + k) for k in range(DEGREE + 1)]
            self._stacks[m] = start, np.stack([self._diffuse_of(m), *known])
        return Responses(self._stacks[m][1], share, slope / roughness)

    def _diffuse_of(self, m: int) -> Float[np.ndarray, "n p"]:
        """Return D of material m, computed once."""
        if m not in self._diffuse:
            self._diffuse[m] = self._evaluate(m, None)
        return self._diffuse[m]

    def _specular_at_node(self, m: int, node: int) -> Float[np.ndarray, "n p"]:
        """Return S of material m at a node; the `CACHED_NODES` nearest nodes stay in memory."""
        cached = self._specular.setdefault(m, {})
        if node not in cached:
            for distant in sorted(cached, key=lambda k: abs(k - node))[CACHED_NODES - 1 :]:
                del cached[distant]
            cached[node] = self._evaluate(m, float(self.nodes[node]))
        return cached[node]

    def _evaluate(self, m: int, roughness: float | None) -> Float[np.ndarray, "n p"]:
        """Return S of material m at a roughness, or D if that is None."""
        rows = self.rows(m)
        parts = []
        for i in range(rows.start, rows.stop, CHUNK):
            chunk = np.arange(i, min(i + CHUNK, rows.stop))
            if roughness is None:
                parts.append(diffuse_response(self.block, chunk, self.lobes, self.operator))
            else:
                parts.append(specular_response(self.block, chunk, self.lobes, roughness, self.operator))
        return np.vstack(parts).astype(np.float32)


class ResponseCache:
    """Cache of response tables, shared by fits; it keeps the `CACHED_TABLES` last used.

    Fits that compare models have the same observations and lobes.  Only radiance, materials and weights differ.
    """

    def __init__(self) -> None:
        self._tables: OrderedDict[bytes, ResponseTable] = OrderedDict()
        self._lock = Lock()  # lights are spread over threads

    def get(
        self, block: Block, lobes: UnitLobes, operator: Operator, fixed_roughness: Float[np.ndarray, " m"] | None = None
    ) -> ResponseTable:
        """Return the table of a block.

        Args:
            block: Observations.
            lobes: Lobes of weight one.
            operator: Reflection operator.
            fixed_roughness: Roughness of all materials if it does not change; otherwise None.
        """
        optional = (
            block.visibility,
            block.directions,
            block.place if lobes.curvature else None,
            fixed_roughness,
        )
        arrays = [block.normal, block.view, block.material, block.photo, lobes.axis, lobes.sharpness, *optional]
        digest = blake2b(repr((id(operator), lobes.curvature, [array is None for array in optional])).encode())
        for array in arrays:
            digest.update(b"" if array is None else np.ascontiguousarray(array).data)
        key = digest.digest()
        with self._lock:
            table = self._tables.pop(key, None) or ResponseTable(block, lobes, operator, fixed_roughness is not None)
            self._tables[key] = table
            while len(self._tables) > CACHED_TABLES:
                self._tables.popitem(last=False)
        return table


@lru_cache(maxsize=256)  # all lights ask for the same materials
def lagrange_weights(nodes: tuple[float, ...], x: float) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the weights of values at `nodes` in the interpolating polynomial at x, and in its derivative.

    >>> [w.tolist() for w in lagrange_weights((0.0, 1.0, 2.0), 0.25)]
    [[0.65625, 0.4375, -0.09375], [-1.25, 1.5, -0.25]]
    """
    value = []
    slope = []
    for a, node in enumerate(nodes):
        other_nodes = nodes[:a] + nodes[a + 1 :]
        below = prod(node - node_b for node_b in other_nodes)
        value.append(prod(x - node_b for node_b in other_nodes) / below)
        slope.append(
            sum(prod(x - node_b for node_b in other_nodes[:b] + other_nodes[b + 1 :]) for b in range(len(other_nodes)))
            / below
        )
    return np.array(value), np.array(slope)
