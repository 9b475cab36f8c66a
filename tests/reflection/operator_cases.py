"""Special cases of the reflection operators, and laws of theirs.

Errors are |R − S| / (S + E/100); of gradients |∂R − ∂S| / (|∂S| + S + E/100), as lobe, view and normal turn.  Formulas
break at grazing views, mirrors, lobes of no width or of all, and lobes along every special direction: a case differs
from the ordinary in one respect, the last one in all of them.
"""

import itertools
import math
from types import SimpleNamespace

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from factorlib.reflection import Operator, reflection_operator
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.samples import specular_inputs

# ── Special cases ────────────────────────────────────────────────────────────────────────────────────────────────────

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
        """Return E/100, what errors are measured in beside the value itself."""
        return lobe_integral(self.sharpness) / 100

    def groups(self) -> list[tuple[float, float, Tensor]]:
        """Return (roughness, sharpness, rows) of those that share both."""
        keys = torch.stack([self.roughness, self.sharpness], 1).unique(dim=0).tolist()
        return [(r, lam, ((self.roughness == r) & (self.sharpness == lam)).nonzero()[:, 0]) for r, lam in keys]


def case(name: str) -> Pairs:
    """Return the pairs of a case: every combination of its values."""
    together = [*CASES.values(), ORDINARY] if name == ALL else [ORDINARY | CASES[name]]
    choices = {key: tuple(dict.fromkeys(v for c in together for v in c.get(key, ()))) for key in ORDINARY}
    rows = []
    n = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for r, lam, cosine in itertools.product(choices["roughness"], choices["sharpness"], choices["no"]):
        o = torch.tensor([math.sqrt(1 - cosine**2), 0.0, cosine], dtype=torch.float64)
        z = torch.cat([_directions(place, n, o) for place in choices["place"]])
        scalars = torch.tensor([[r, lam]], dtype=torch.float64).expand(len(z), 2)
        rows.append(torch.cat([scalars, n.expand(len(z), 3), o.expand(len(z), 3), z], 1))
    table = torch.cat(rows)
    return Pairs(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:8], table[:, 8:])


def _directions(place: str, n: Float[Tensor, "3"], o: Float[Tensor, "3"]) -> Float[Tensor, "_ 3"]:
    special = {"n": n, "−n": -n, "o": o, "−o": -o, "mirror": 2 * (n @ o) * n - o}
    if place in special:
        return special[place][None]
    z = _unit(COUNT, torch.Generator().manual_seed(3))
    height = (z @ n).abs()[:, None] * n
    flat = z - (z @ n)[:, None] * n
    return {"front": flat + height, "behind": flat - height, "horizon": normalize(flat, dim=1)}[place]


def _unit(count: int, g: torch.Generator) -> Float[Tensor, "count 3"]:
    return normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1)


class Answers(msgspec.Struct, frozen=True):
    """Answers of an operator for pairs, float64.

    They are every field of its Response, and the specular gradient by three directions.

    Derivatives by n·o, n·z and o·z mean little alone: at the mirror direction no unit vectors change one and not the
    others.  What counts is how the value changes as lobe, view or normal turn, formed in the operator's own precision:
    for the lobe |P (∂ₙz n + ∂ₒz o)|, P = I − z zᵀ.
    """

    fields: dict[str, Tensor]
    turning: Float[Tensor, "k 3 3"]  # by lobe, view, normal

    def finite(self) -> bool:
        """Tell whether all answers are finite."""
        return all(bool(t.isfinite().all()) for t in (*self.fields.values(), self.turning))


def answers(operator: Operator, pairs: Pairs) -> Answers:
    """Compute values and derivatives of all pairs."""
    fields: dict[str, Tensor] = {}
    turning = torch.empty(len(pairs), 3, 3, dtype=torch.float64)
    n, o, z = (t.to(operator.dtype) for t in (pairs.normal, pairs.view, pairs.axis))
    no, nz, oz = ((a * b).sum(1) for a, b in ((n, o), (n, z), (o, z)))
    for r, lam, rows in pairs.groups():
        roughness = torch.tensor(r, dtype=operator.dtype)
        sharpness = torch.tensor([lam], dtype=operator.dtype)
        response = operator.response(roughness, sharpness, no[rows], nz[rows, None], oz[rows, None])
        for name in response.__struct_fields__:
            column = getattr(response, name)[:, 0].double()
            fields.setdefault(name, torch.empty(len(pairs), dtype=torch.float64))[rows] = column
        by_no = response.specular_by_no
        by_nz = response.specular_by_nz
        by_oz = response.specular_by_oz
        turns = ((z, n, by_nz), (z, o, by_oz)), ((o, n, by_no), (o, z, by_oz)), ((n, o, by_no), (n, z, by_nz))
        for k, parts in enumerate(turns):
            across = [(slope, other - (axis * other).sum(1, keepdim=True) * axis) for axis, other, slope in parts]
            turning[rows, k] = torch.stack([slope * vector[rows] for slope, vector in across]).sum(0).double()
    return Answers(fields, turning)


def value_error(a: Answers, b: Answers, pairs: Pairs) -> Float[Tensor, " k"]:
    """Return |a − b| / (b + E/100), the greater of diffuse and specular."""
    parts = [(a.fields[p] - b.fields[p]).abs() / (b.fields[p] + pairs.scale()) for p in ("diffuse", "specular")]
    return torch.maximum(*parts)


def gradient_error(a: Answers, b: Answers, pairs: Pairs) -> Float[Tensor, " k"]:
    """Return |∂a − ∂b| / (|∂b| + b + E/100): the greatest of all derivatives that mean something alone."""
    worst = torch.zeros(len(pairs), dtype=torch.float64)
    for name in ("diffuse_by_log_sharpness", "diffuse_by_nz", "specular_by_roughness", "specular_by_log_sharpness"):
        base = b.fields[name.partition("_")[0]] + pairs.scale()
        worst = worst.maximum((a.fields[name] - b.fields[name]).abs() / (b.fields[name].abs() + base))
    size = b.turning.norm(dim=2) + (b.fields["specular"] + pairs.scale())[:, None]
    return worst.maximum(((a.turning - b.turning).norm(dim=2) / size).amax(1))


def reference_values(pairs: Pairs, some: slice = slice(None)) -> dict[str, Tensor]:
    """Compute diffuse and specular by quadrature, of some of the pairs."""
    reference = reflection_operator("reference")
    n, o, z = (t[some] for t in (pairs.normal, pairs.view, pairs.axis))
    no, nz, oz = ((a * b).sum(1) for a, b in ((n, o), (n, z), (o, z)))
    sharpness = pairs.sharpness[some, None]
    with torch.no_grad():
        specular = reference.specular(pairs.roughness[some, None], sharpness, no, nz[:, None], oz[:, None])[:, 0]
        return {"diffuse": reference.diffuse(sharpness, nz[:, None])[:, 0], "specular": specular}


# ── Laws, which hold exactly for the true reflection: 0 ≤ D, S ≤ 1 of unit lobes ─────────────────────────────────────


def draw_inputs(least_roughness: float, least_no: float, count: int) -> tuple[Tensor, ...]:
    """Draw α, λ in [10⁻⁴, 10⁶], n·o, n·z, o·z: those of `samples`; half of the views crowd at the least n·o."""
    alpha = (least_roughness**2, 1.0)
    return specular_inputs(count, 17, alpha=alpha, sharpness=(1e-4, 1e6), least_no=least_no)


def draw_grazing_inputs(least_roughness: float, least_no: float, count: int) -> tuple[Tensor, ...]:
    """Draw pairs like `draw_inputs`, all at the least n·o, the lobe about the mirror direction."""
    alpha, lam, _, nz, _ = draw_inputs(least_roughness, least_no, count)
    turn = torch.linspace(-1, 1, count, dtype=torch.float64)  # of the axis about n, from the mirror direction
    across = math.sqrt(1 - least_no**2) * torch.sqrt(1 - nz**2) * torch.cos(turn)
    return alpha, lam, torch.full_like(alpha, least_no), nz, least_no * nz - across


def specular_values(operator: Operator, *scalars: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Return the specular part of α, λ, n·o, n·z, o·z that share nothing."""
    a, lam, no, nz, oz = (t.to(operator.dtype) for t in scalars)
    with torch.no_grad():
        return operator.specular(a.sqrt()[:, None], lam[:, None], no, nz[:, None], oz[:, None])[:, 0].double()


def scene(seed: int, points: int = 32, lobes: int = 6, sharpness: tuple[float, float] = (0.0, 3.0)) -> tuple:
    """Draw a light, a material and points that face the viewer at 60° or less, float64.

    sharpness: 10 to the power of this range
    """
    g = torch.Generator().manual_seed(seed)
    axis = _unit(lobes, g)
    spread = torch.logspace(*sharpness, lobes, dtype=torch.float64)
    light = SimpleNamespace(axis=axis, sharpness=spread, weight=torch.rand(lobes, 3, generator=g).double())
    diffuse, specular, roughness = (torch.tensor(v).double() for v in ([0.3, 0.2, 0.1], [0.2, 0.3, 0.4], 0.4))
    normals = _unit(points, g)
    material = SimpleNamespace(diffuse=diffuse, specular=specular, roughness=roughness)
    return light, material, normals, normalize(normals + 0.8 * _unit(points, g), dim=1)
