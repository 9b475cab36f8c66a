"""A light as log radiance on a fixed lattice of lobes, and what observations reflect of the lattice.

Every lobe of the lattice is half as wide as its neighbours are apart, so that equal weights make a nearly constant light.  Nothing but the weights
is unknown, so responses depend on materials through their roughness alone.  The specular ones are computed at a few roughnesses, the
`NODES`, when they are first asked for, and interpolated between them by cubic polynomials of log roughness.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.blocks import Block
from factorlib.model.lights import Light, UnitLobes
from factorlib.model.responses import CHUNK, unit_values
from factorlib.reflection.operator import Operator

WIDTH = 0.5  # of a lobe, in spacings of the lattice: equal weights are a constant light to 2 % (RMS); wider ones blur a sun more than materials do
NODES = np.array([0.1, 0.14, 0.19, 0.25, 0.32, 0.4, 0.49, 0.59, 0.7, 0.84, 1.0])  # roughness
DEGREE = 3  # of the polynomials between nodes


class Lattice(msgspec.Struct, frozen=True):
    """p lobes on `fibonacci_sphere(p)`.

    sharpness   λ of each
    peak        radiance of a lobe where the light is a constant of radiance 1: one over how many lobes overlap
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: float
    peak: float

    @staticmethod
    def of(count: int) -> Lattice:
        """The lattice of `count` lobes."""
        spacing = np.sqrt(4 * np.pi / count)
        sharpness = 1 / (WIDTH * spacing) ** 2
        overlap = count / (4 * np.pi) * 2 * np.pi / sharpness * -np.expm1(-2 * sharpness)
        return Lattice(fibonacci_sphere(count), float(sharpness), float(1 / overlap))

    def __len__(self) -> int:
        return len(self.axis)

    @property
    def unit_lobes(self) -> UnitLobes:
        """The lobes with weight one."""
        return UnitLobes(self.axis, np.full(len(self), self.sharpness))

    def weight(self, log_radiance: Float[np.ndarray, "3 p"]) -> Float[np.ndarray, "p 3"]:
        """The lobes' weights where cells of the light have radiance exp(u)."""
        return np.exp(log_radiance.T) * self.peak

    def light(self, log_radiance: Float[np.ndarray, "3 p"], like: Light) -> Light:
        """As lobes, with the exposures and tone curves of another light."""
        log_sharpness = np.full(len(self), np.log(self.sharpness))
        return msgspec.structs.replace(like, axis=self.axis, log_sharpness=log_sharpness, weight=self.weight(log_radiance))


class Reflected(NamedTuple):
    """Of the n observations of one material and p lobes of weight one: responses D and S [n, p], and ∂S/∂roughness; float32."""

    diffuse: Float[np.ndarray, "n p"]
    specular: Float[np.ndarray, "n p"]
    by_roughness: Float[np.ndarray, "n p"]


class Reflections:
    """What a block's observations reflect of a lattice, material by material; values at nodes are kept."""

    def __init__(self, block: Block, lattice: Lattice, operator: Operator):
        self.block, self.operator, self.lobes = block, operator, lattice.unit_lobes
        self._specular: dict[tuple[int, int], np.ndarray] = {}
        self._diffuse: dict[int, np.ndarray] = {}

    def rows(self, m: int) -> slice:
        """The observations of material m: blocks are sorted by material."""
        first, last = np.searchsorted(self.block.material, [m, m + 1])
        return slice(int(first), int(last))

    def at(self, m: int, roughness: float) -> Reflected:
        """The responses of material m, were its roughness so."""
        first = int(np.clip(np.searchsorted(NODES, roughness) - 2, 0, len(NODES) - DEGREE - 1))
        nodes = range(first, first + DEGREE + 1)
        share, slope = lagrange(np.log(NODES[list(nodes)]), float(np.log(roughness)))
        known = [self._at_node(m, k) for k in nodes]
        specular = sum(np.float32(a) * values for a, values in zip(share, known, strict=True))
        by_roughness = sum(np.float32(a / roughness) * values for a, values in zip(slope, known, strict=True))
        return Reflected(self._diffuse[m], specular, by_roughness)

    def _at_node(self, m: int, k: int) -> Float[np.ndarray, "n p"]:
        if (m, k) not in self._specular:
            rows = self.rows(m)
            chunks = [np.arange(i, min(i + CHUNK, rows.stop)) for i in range(rows.start, rows.stop, CHUNK)]
            parts = [unit_values(self.block, chunk, self.lobes, float(NODES[k]), self.operator) for chunk in chunks]
            self._specular[m, k] = np.vstack([specular for _, specular in parts]).astype(np.float32)
            if m not in self._diffuse:
                self._diffuse[m] = np.vstack([diffuse for diffuse, _ in parts]).astype(np.float32)
        return self._specular[m, k]


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
