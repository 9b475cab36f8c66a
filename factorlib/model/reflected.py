"""What a block's observations reflect of the cells of a light, at any roughness: responses tabulated at a few roughnesses.

The cells of a light stay where they are while a solve descends, so responses depend on materials through their roughness alone.  They are
computed at the `NODES` when they are first asked for and interpolated between them by cubic polynomials of log roughness.  The peak of a
highlight of a sharp cell falls with roughness⁻⁴; between nodes apart by a factor h, interpolation leaves (9/384)(4 ln h)⁴ of it at worst:
.17 % for the factor 1.136 of the nodes.  Cells no sharper than `WIDE` blur highlights, and every second node is near enough.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.lights import UnitLobes
from factorlib.model.responses import CHUNK, diffuse_response, specular_response
from factorlib.reflection.operator import Operator

NODES = np.geomspace(0.1, 1.0, 19)  # roughness
WIDE = 200.0  # λ
DEGREE = 3  # of the polynomials between nodes
KEPT = 6  # nodes of a material whose responses stay in memory


class Reflected(NamedTuple):
    """The responses D and S [n, p] of n observations of one material to p lobes of weight one, and ∂S/∂roughness; float32."""

    diffuse: Float[np.ndarray, "n p"]
    specular: Float[np.ndarray, "n p"]
    by_roughness: Float[np.ndarray, "n p"]


class Reflections:
    """What a block's observations reflect of some lobes, material by material; values at nodes are kept.

    materials_given: roughness does not change, so it is the only node, and ∂S/∂roughness, for which nobody asks, is nil
    """

    def __init__(self, block: Block, lobes: UnitLobes, operator: Operator, materials_given: bool = False):
        self.block, self.operator, self.lobes, self.materials_given = block, operator, lobes, materials_given
        self.nodes = NODES[::2] if lobes.sharpness.max(initial=0) <= WIDE else NODES
        self._specular: dict[tuple[int, int], np.ndarray] = {}
        self._diffuse: dict[int, np.ndarray] = {}

    def rows(self, m: int) -> slice:
        """The observations of material m: blocks are sorted by material."""
        first, last = np.searchsorted(self.block.material, [m, m + 1])
        return slice(int(first), int(last))

    def at(self, m: int, roughness: float) -> Reflected:
        """The responses of material m, were its roughness so."""
        if self.materials_given:
            if (m, 0) not in self._specular:
                self._specular[m, 0] = self._in_chunks(m, self.lobes, roughness)
            specular = self._specular[m, 0]
            return Reflected(self._diffuse_of(m), specular, np.broadcast_to(np.float32(0), specular.shape))
        first = int(np.clip(np.searchsorted(self.nodes, roughness) - 2, 0, len(self.nodes) - DEGREE - 1))
        nodes = range(first, first + DEGREE + 1)
        share, slope = lagrange(np.log(self.nodes[list(nodes)]), float(np.log(roughness)))
        known = [self._at_node(m, k) for k in nodes]
        specular = sum(np.float32(a) * values for a, values in zip(share, known, strict=True))
        by_roughness = sum(np.float32(a / roughness) * values for a, values in zip(slope, known, strict=True))
        return Reflected(self._diffuse_of(m), specular, by_roughness)

    def _diffuse_of(self, m: int) -> Float[np.ndarray, "n p"]:
        if m not in self._diffuse:
            self._diffuse[m] = self._in_chunks(m, self.lobes)
        return self._diffuse[m]

    def _at_node(self, m: int, k: int) -> Float[np.ndarray, "n p"]:
        if (m, k) not in self._specular:
            mine = sorted((key for key in self._specular if key[0] == m), key=lambda key: abs(key[1] - k))
            for key in mine[KEPT - 1 :]:
                del self._specular[key]
            self._specular[m, k] = self._in_chunks(m, self.lobes, float(self.nodes[k]))
        return self._specular[m, k]

    def _in_chunks(self, m: int, lobes: UnitLobes, roughness: float | None = None) -> Float[np.ndarray, "n p"]:
        """D of material m, or S where a roughness is given."""
        rows, parts = self.rows(m), []
        for i in range(rows.start, rows.stop, CHUNK):
            chunk = np.arange(i, min(i + CHUNK, rows.stop))
            if roughness is None:
                parts.append(diffuse_response(self.block, chunk, lobes, self.operator))
            else:
                parts.append(specular_response(self.block, chunk, lobes, roughness, self.operator))
        return np.vstack(parts).astype(np.float32)


def lagrange(nodes: Float[np.ndarray, " k"], x: float) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Weights of values at `nodes` that give the interpolating polynomial's value at x, and its derivative there.

    >>> [w.tolist() for w in lagrange(np.array([0.0, 1.0, 2.0]), 0.25)]
    [[0.65625, 0.4375, -0.09375], [-1.25, 1.5, -0.25]]
    """
    value, slope = np.empty(len(nodes)), np.empty(len(nodes))
    for a, node in enumerate(nodes):
        others = np.delete(nodes, a)
        below = np.prod(node - others)
        value[a] = np.prod(x - others) / below
        slope[a] = sum(np.prod(x - np.delete(others, b)) for b in range(len(others))) / below
    return value, slope
