"""Where formulas break: grazing views, mirrors, lobes of no width or of all, and lobes along every special direction.

A case differs from the ordinary in one respect; the last one changes all of them at once.
"""

from __future__ import annotations

import itertools
import math

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection import Operator
from factorlib.reflection.lobe import lobe_integral

ORDINARY = {
    "roughness": (0.1, 0.3, 0.6),
    "sharpness": (1.0, 10.0, 100.0, 1000.0),
    "no": (0.1, 0.4, 0.7, 0.95),
    "place": ("front",),
}
CASES: dict[str, dict] = {
    "none: ordinary": {},
    "lobe behind the surface": {"place": ("behind",)},
    "lobe on the horizon": {"place": ("horizon",)},
    "view at n·o = 10⁻⁴": {"no": (1e-4,)},
    "view along n": {"no": (1.0,)},
    "roughness .03": {"roughness": (0.03,)},
    "roughness 1": {"roughness": (1.0,)},
    "sharpness 10⁻⁴": {"sharpness": (1e-4,)},
    "sharpness 10⁶": {"sharpness": (1e6,)},
    "lobe along n": {"place": ("n",)},
    "lobe along −n": {"place": ("−n",)},
    "lobe along the mirror direction": {"place": ("mirror",)},
    "lobe along o": {"place": ("o",)},
    "lobe along −o": {"place": ("−o",)},
}
ALL = "all of these at once"
COUNT = 6  # random directions of a place that is not one direction


class Pairs(msgspec.Struct, frozen=True):
    """Points under one lobe each, float64; vectors are unit, [k, 3]."""

    roughness: Float[Tensor, " k"]
    sharpness: Float[Tensor, " k"]
    normal: Float[Tensor, "k 3"]
    view: Float[Tensor, "k 3"]
    axis: Float[Tensor, "k 3"]

    def __len__(self) -> int:
        return len(self.roughness)

    def scale(self) -> Float[Tensor, " k"]:
        """E/100, what errors are measured in beside the value itself."""
        return lobe_integral(self.sharpness) / 100

    def groups(self) -> list[tuple[float, float, Tensor]]:
        """(roughness, sharpness, rows) of those that share both."""
        keys = torch.stack([self.roughness, self.sharpness], 1).unique(dim=0).tolist()
        return [(r, lam, ((self.roughness == r) & (self.sharpness == lam)).nonzero()[:, 0]) for r, lam in keys]


def case(name: str) -> Pairs:
    if name == ALL:
        together = list(CASES.values())
        choices = {
            key: tuple(dict.fromkeys(v for c in [*together, ORDINARY] for v in c.get(key, ()))) for key in ORDINARY
        }
    else:
        choices = ORDINARY | CASES[name]
    return pairs(**choices)


def pairs(roughness: tuple, sharpness: tuple, no: tuple, place: tuple) -> Pairs:
    """Every combination."""
    rows = []
    for r, lam, cosine in itertools.product(roughness, sharpness, no):
        n = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        o = torch.tensor([math.sqrt(1 - cosine**2), 0.0, cosine], dtype=torch.float64)
        z = torch.cat([directions(p, n, o) for p in place])
        scalars = torch.tensor([[r, lam]], dtype=torch.float64).expand(len(z), 2)
        rows.append(torch.cat([scalars, n.expand(len(z), 3), o.expand(len(z), 3), z], 1))
    table = torch.cat(rows)
    return Pairs(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:8], table[:, 8:])


def directions(place: str, n: Float[Tensor, "3"], o: Float[Tensor, "3"]) -> Float[Tensor, "_ 3"]:
    exact = {"n": n, "−n": -n, "o": o, "−o": -o, "mirror": 2 * (n @ o) * n - o}
    if place in exact:
        return exact[place][None]
    g = torch.Generator().manual_seed(3)
    z = torch.nn.functional.normalize(torch.randn(COUNT, 3, generator=g, dtype=torch.float64), dim=1)
    height = (z @ n).abs()[:, None] * n
    flat = z - (z @ n)[:, None] * n
    return {"front": flat + height, "behind": flat - height, "horizon": torch.nn.functional.normalize(flat, dim=1)}[
        place
    ]


class Found(msgspec.Struct, frozen=True):
    """What an operator says of pairs, float64: every field of its Response, and the specular gradient by three directions.

    Derivatives by n·o, n·z and o·z mean little alone: at the mirror direction no unit vectors change one and not the
    others.  What counts is how the value changes as lobe, view or normal turn, formed in the operator's own precision:
    for the lobe |P (∂ₙz n + ∂ₒz o)|, P = I − z zᵀ.
    """

    fields: dict[str, Tensor]
    turning: Float[Tensor, "k 3 3"]  # by lobe, view, normal

    def finite(self) -> bool:
        return all(bool(t.isfinite().all()) for t in (*self.fields.values(), self.turning))


def found(operator: Operator, given: Pairs) -> Found:
    fields: dict[str, Tensor] = {}
    turning = torch.empty(len(given), 3, 3, dtype=torch.float64)
    n, o, z = (t.to(operator.dtype) for t in (given.normal, given.view, given.axis))
    no, nz, oz = ((a * b).sum(1) for a, b in ((n, o), (n, z), (o, z)))
    for r, lam, rows in given.groups():
        roughness, sharpness = torch.tensor(r, dtype=operator.dtype), torch.tensor([lam], dtype=operator.dtype)
        response = operator.response(roughness, sharpness, no[rows], nz[rows, None], oz[rows, None])
        for name in response.__struct_fields__:
            fields.setdefault(name, torch.empty(len(given), dtype=torch.float64))[rows] = getattr(response, name)[
                :, 0
            ].double()
        by_no, by_nz, by_oz = response.specular_by_no, response.specular_by_nz, response.specular_by_oz
        turns = ((z, n, by_nz), (z, o, by_oz)), ((o, n, by_no), (o, z, by_oz)), ((n, o, by_no), (n, z, by_nz))
        for k, parts in enumerate(turns):
            turning[rows, k] = sum(slope * across(moved, other)[rows] for moved, other, slope in parts).double()
    return Found(fields, turning)


def across(axis: Float[Tensor, "k 3"], vector: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """What of a vector stands across a unit axis."""
    return vector - (axis * vector).sum(1, keepdim=True) * axis


def value_error(a: Found, b: Found, given: Pairs) -> Float[Tensor, " k"]:
    """|a − b| / (b + E/100), the greater of diffuse and specular."""
    parts = [(a.fields[p] - b.fields[p]).abs() / (b.fields[p] + given.scale()) for p in ("diffuse", "specular")]
    return torch.maximum(*parts)


def gradient_error(a: Found, b: Found, given: Pairs) -> Float[Tensor, " k"]:
    """|∂a − ∂b| / (|∂b| + b + E/100): the greatest of all derivatives that mean something alone."""
    worst = torch.zeros(len(given), dtype=torch.float64)
    for name in ("diffuse_by_log_sharpness", "diffuse_by_nz", "specular_by_roughness", "specular_by_log_sharpness"):
        base = b.fields[name.partition("_")[0]] + given.scale()
        worst = worst.maximum((a.fields[name] - b.fields[name]).abs() / (b.fields[name].abs() + base))
    size = b.turning.norm(dim=2) + (b.fields["specular"] + given.scale())[:, None]
    return worst.maximum(((a.turning - b.turning).norm(dim=2) / size).amax(1))
