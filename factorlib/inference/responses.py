"""What rows of observations reflect of lobes of weight one: the reflection operator, asked for a block.

    D_ip → a_i v_ip D_ip   diffuse response of observation i to lobe p, for k_d = 1, times the block's detail of reflectance a, where it has some
    S_ip → u_ip S_ip   specular response, for k_s = 1, times the shares v and u of each lobe's reflection that shadows leave:
                       (1) and (2) of `factorlib.light.visibility`, 1 where a block has no visibility

The cells of a light stay where they are while a solve descends, so responses depend on materials through their roughness alone.
`Reflections` computes them at the `NODES` when they are first asked for and interpolates between them by cubic polynomials of log roughness.
The peak of a highlight of a sharp cell falls with roughness⁻⁴; between nodes apart by a factor h, interpolation leaves (9/384)(4 ln h)⁴ of it
at worst: .17 % for the factor 1.136 of the nodes.  Cells no sharper than `WIDE` blur highlights, and every second node is near enough.
"""

from __future__ import annotations

from collections import OrderedDict
from hashlib import blake2b
from math import prod
from threading import Lock
from typing import NamedTuple, Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.inference.blocks import Block
from factorlib.inference.lights import UnitLobes
from factorlib.light.distance import met_from
from factorlib.light.visibility import cosine_weights, highlight_weights, kernel, seen_share
from factorlib.reflection.operator import Operator

CHUNK = 4096  # observations whose responses are computed at once
TOGETHER = 512  # observations whose visibility a processor's cache holds
NODES = np.geomspace(0.1, 1.0, 19)  # roughness
WIDE = 200.0  # λ
DEGREE = 3  # of the polynomials between nodes
KEPT = 6  # nodes of a material whose responses stay in memory
KEPT_TABLES = 16  # about 400 MB
Rows = slice | Int[np.ndarray, " n"]


def diffuse_response(block: Block, rows: Rows, lobes: UnitLobes, operator: Operator) -> Float[np.ndarray, "n p"]:
    """D at `rows`; float64."""
    nz, _, larger = met_cosines(block, rows, lobes)
    with torch.no_grad():
        response = operator.diffuse(_tensor(lobes.sharpness, operator), _tensor(nz, operator))
        seen = larger * shadowed(response, block, rows, lobes).double().numpy()
        return seen if block.detail is None else seen * block.detail[rows][:, None]


def specular_response(
    block: Block, rows: Rows, lobes: UnitLobes, roughness: float, operator: Operator
) -> Float[np.ndarray, "n p"]:
    """S at `rows`, for a material of that roughness; float64."""
    nz, oz, larger = met_cosines(block, rows, lobes)
    no = (block.normal[rows] * block.view[rows]).sum(1)
    inputs = (_tensor(v, operator) for v in (np.array(roughness), lobes.sharpness, no, nz, oz))
    with torch.no_grad():
        return larger * shadowed(operator.specular(*inputs), block, rows, lobes, roughness).double().numpy()


def met_cosines(block: Block, rows: Rows, lobes: UnitLobes) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
    """n·z', o·z' and w'/w of (1) of `factorlib.light.distance` [n, p]; for shadows alone the light is far away."""
    normal = block.normal[rows]
    view = block.view[rows]
    if lobes.curvature == 0 or block.place is None:
        return normal @ lobes.axis.T, view @ lobes.axis.T, 1.0
    return met_from(block.place[rows], normal, view, lobes.axis, lobes.curvature)


def _tensor(values: np.ndarray, operator: Operator) -> Tensor:
    return torch.as_tensor(values).to(operator.dtype)


def shadowed(
    response: Float[Tensor, "n p"], block: Block, rows: Rows, lobes: UnitLobes, roughness: float | None = None
) -> Float[Tensor, "n p"]:
    """The response to lobes at `rows` with shadows: the diffuse one, or the specular one of a material of that roughness."""
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
        own = np.flatnonzero(hidden & (photo == k))
        lit = kernel(directions, axis, sharpness)
        for some in np.split(own, range(TOGETHER, len(own), TOGETHER)):
            weights = (
                cosine_weights(normal[some], directions)
                if roughness is None
                else highlight_weights(normal[some], view[some], directions, float(roughness))
            )
            share = seen_share(torch.from_numpy(visibility[some]).float() / 255, weights, lit)
            response[some] *= share.to(response.dtype)
    return response


class Reflected(NamedTuple):
    """Responses of n observations of one material to p lobes of weight one.

    stack          D, then S at each of k nodes of roughness, float32
    share, slope   weights of the k nodes that give S, and ∂S/∂roughness
    """

    stack: Float[np.ndarray, "k+1 n p"]
    share: Float[np.ndarray, " k"]
    slope: Float[np.ndarray, " k"]

    @property
    def diffuse(self) -> Float[np.ndarray, "n p"]:
        """Return D."""
        return self.stack[0]

    @property
    def specular(self) -> Float[np.ndarray, "n p"]:
        """Return S."""
        return self._weighted(self.share)

    @property
    def by_roughness(self) -> Float[np.ndarray, "n p"]:
        """Return ∂S/∂roughness."""
        return self._weighted(self.slope)

    def _weighted(self, weights: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n p"]:
        return np.tensordot(weights.astype(np.float32), self.stack[1:], axes=1)

    def radiance(self, weight: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "3 n 3"]:
        """Return D w, S w and (∂S/∂roughness) w, without forming S."""
        nodes, n, p = self.stack.shape
        sums = (self.stack.reshape(-1, p) @ weight.astype(np.float32)).reshape(nodes, 3 * n).astype(float)
        return np.stack([sums[0], self.share @ sums[1:], self.slope @ sums[1:]]).reshape(3, n, 3)

    def by_weight(
        self, by_diffuse: Float[np.ndarray, "n 3"], by_specular: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "p 3"]:
        """Return Dᵀ a + Sᵀ b: the gradient by weights of a value whose gradient by D w is a, and by S w is b."""
        slopes = np.concatenate([by_diffuse[None], self.share[:, None, None] * by_specular]).astype(np.float32)
        return (self.stack.reshape(-1, self.stack.shape[2]).T @ slopes.reshape(-1, 3)).astype(float)


class Table(Protocol):
    """Responses of a block, material by material."""

    def rows(self, m: int) -> slice: ...

    def at(self, m: int, roughness: float) -> Reflected: ...


class Reflections:
    """Responses of a block's observations to some lobes, material by material, float32; values at nodes are kept.

    materials_given: roughness does not change, so it is the only node, and ∂S/∂roughness, for which nobody asks, is nil
    """

    def __init__(self, block: Block, lobes: UnitLobes, operator: Operator, materials_given: bool = False):
        self.block = block
        self.operator = operator
        self.lobes = lobes
        self.materials_given = materials_given
        self.nodes = NODES[::2] if lobes.sharpness.max(initial=0) <= WIDE else NODES
        self._diffuse: dict[int, np.ndarray] = {}  # by material
        self._specular: dict[int, dict[int, np.ndarray]] = {}  # by material and node
        self._stacks: dict[int, tuple[int, np.ndarray]] = {}  # by material: the first node, and the stack from there on

    def rows(self, m: int) -> slice:
        """The observations of material m: blocks are sorted by material."""
        first, last = np.searchsorted(self.block.material, [m, m + 1])
        return slice(int(first), int(last))

    def at(self, m: int, roughness: float) -> Reflected:
        """The responses of material m, were its roughness so."""
        if self.materials_given:
            if m not in self._stacks:
                self._stacks[m] = 0, np.stack([self._diffuse_of(m), self._computed(m, roughness)])
            return Reflected(self._stacks[m][1], np.ones(1), np.zeros(1))
        first = int(np.clip(np.searchsorted(self.nodes, roughness) - 2, 0, len(self.nodes) - DEGREE - 1))
        nodes = self.nodes[first : first + DEGREE + 1]
        share, slope = lagrange(np.log(nodes), float(np.log(roughness)))
        if self._stacks.get(m, (None,))[0] != first:
            known = [self._specular_at(m, first + k) for k in range(DEGREE + 1)]
            self._stacks[m] = first, np.stack([self._diffuse_of(m), *known])
        return Reflected(self._stacks[m][1], share, slope / roughness)

    def _diffuse_of(self, m: int) -> Float[np.ndarray, "n p"]:
        if m not in self._diffuse:
            self._diffuse[m] = self._computed(m, None)
        return self._diffuse[m]

    def _specular_at(self, m: int, node: int) -> Float[np.ndarray, "n p"]:
        kept = self._specular.setdefault(m, {})
        if node not in kept:
            for far in sorted(kept, key=lambda k: abs(k - node))[KEPT - 1 :]:
                del kept[far]
            kept[node] = self._computed(m, float(self.nodes[node]))
        return kept[node]

    def _computed(self, m: int, roughness: float | None) -> Float[np.ndarray, "n p"]:
        """S of material m at a roughness, or D where that is None."""
        rows = self.rows(m)
        parts = []
        for i in range(rows.start, rows.stop, CHUNK):
            chunk = np.arange(i, min(i + CHUNK, rows.stop))
            if roughness is None:
                parts.append(diffuse_response(self.block, chunk, self.lobes, self.operator))
            else:
                parts.append(specular_response(self.block, chunk, self.lobes, roughness, self.operator))
        return np.vstack(parts).astype(np.float32)


class Tables:
    """Tables of responses that fits have in common, the `KEPT_TABLES` that were asked for last.

    Fits that compare models have the same observations and lobes; only radiance, materials and weights differ.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[bytes, Reflections] = OrderedDict()
        self._lock = Lock()  # lights are spread over threads

    def of(
        self, block: Block, lobes: UnitLobes, operator: Operator, given: Float[np.ndarray, " m"] | None = None
    ) -> Reflections:
        """Return the table of a block; given: the roughness of all materials, where it does not change."""
        optional = (block.visibility, block.directions, block.detail, block.place if lobes.curvature else None, given)
        arrays = [block.normal, block.view, block.material, block.photo, lobes.axis, lobes.sharpness, *optional]
        digest = blake2b(repr((id(operator), lobes.curvature, [of is None for of in optional])).encode())
        for array in arrays:
            digest.update(b"" if array is None else np.ascontiguousarray(array).data)
        key = digest.digest()
        with self._lock:
            table = self._known.pop(key, None) or Reflections(block, lobes, operator, given is not None)
            self._known[key] = table
            while len(self._known) > KEPT_TABLES:
                self._known.popitem(last=False)
        return table


def lagrange(nodes: Float[np.ndarray, " k"], x: float) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Weights of values at `nodes` that give the interpolating polynomial's value at x, and its derivative there.

    >>> [w.tolist() for w in lagrange(np.array([0.0, 1.0, 2.0]), 0.25)]
    [[0.65625, 0.4375, -0.09375], [-1.25, 1.5, -0.25]]
    """
    value = []
    slope = []
    points = nodes.tolist()
    for a, node in enumerate(points):
        others = points[:a] + points[a + 1 :]
        below = prod(node - other for other in others)
        value.append(prod(x - other for other in others) / below)
        slope.append(sum(prod(x - other for other in others[:b] + others[b + 1 :]) for b in range(len(others))) / below)
    return np.array(value), np.array(slope)
