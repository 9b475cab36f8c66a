"""How far each operator breaks the laws that the reflection of a lobe obeys exactly.

A unit lobe is nowhere brighter than 1, and a surface of k_d = 1 or k_s = 1 reflects no more than arrives: 0 ≤ D, S ≤ 1.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection import Operator
from factorlib.reflection.brdf import specular as brdf
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.samples import specular_inputs


class Domain(msgspec.Struct, frozen=True):
    """Ranges from which roughness and n·o are drawn; sharpness is in [10⁻⁴, 10⁶] always."""

    least_roughness: float
    least_no: float


USUAL, WIDER, WHOLE = Domain(0.1, 0.02), Domain(0.1, 1e-4), Domain(0.03, 1e-4)


def drawn(domain: Domain, count: int) -> tuple[Tensor, ...]:
    """α, λ, n·o, n·z, o·z: those of `samples`, over the domain; half of the views crowd at the least n·o."""
    alpha, lam, no, nz, oz = specular_inputs(
        count, 17, alpha=(domain.least_roughness**2, 1.0), sharpness=(1e-4, 1e6), least_no=domain.least_no
    )
    return alpha, lam, no, nz, oz


def each(operator: Operator, *scalars: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """The specular part of α, λ, n·o, n·z, o·z that share nothing."""
    a, lam, no, nz, oz = (t.to(operator.dtype) for t in scalars)
    with torch.no_grad():
        return operator.specular(a.sqrt()[:, None], lam[:, None], no, nz[:, None], oz[:, None])[:, 0].double()


def grazing(domain: Domain, count: int) -> tuple[Tensor, ...]:
    """As `drawn`, all at the least n·o, the lobe about the mirror direction."""
    alpha, lam, _, nz, _ = drawn(domain, count)
    no = torch.full_like(alpha, domain.least_no)
    so = math.sqrt(1 - domain.least_no**2)
    turn = torch.linspace(-1, 1, count, dtype=torch.float64)  # of the axis about n, from the mirror direction
    sz = torch.sqrt(1 - nz**2)
    return alpha, lam, no, nz, domain.least_no * nz - so * sz * torch.cos(turn)


def tail(error: Float[Tensor, " k"]) -> tuple[float, float]:
    """The 99th percentile and the largest."""
    return float(error.quantile(0.99)), float(error.max())


def unit_lobes(operator: Operator, domain: Domain, count: int = 16384) -> tuple[float, float]:
    """S of unit lobes, p99 and largest; exactly at most 1."""
    return tail(torch.cat([each(operator, *make(domain, count)) for make in (drawn, grazing)]))


def least_reflected(operator: Operator, count: int = 16384) -> tuple[float]:
    return (min(float(each(operator, *make(WHOLE, count)).min()) for make in (drawn, grazing)),)


def white_lambert(operator: Operator, count: int = 512) -> tuple[float]:
    """Largest |D − 1| under constant light of radiance 1 (λ = 10⁻⁴)."""
    lam, nz = torch.tensor([1e-4], dtype=operator.dtype), torch.linspace(-1, 1, count, dtype=operator.dtype)
    with torch.no_grad():
        return (float((operator.diffuse(lam, nz[:, None]) - 1).abs().max()),)


def constant_light(operator: Operator, count: int = 2048) -> tuple[float, float]:
    """S under constant light of radiance 1 (λ = 10⁻⁴), p99 and largest; exactly at most 1."""
    alpha, lam, no, nz, oz = drawn(USUAL, count)
    return tail(each(operator, alpha, torch.full_like(lam, 1e-4), no, nz, oz))


def point_light(operator: Operator, count: int = 4096) -> tuple[float, float]:
    """|S − E f| / (E f + E/100), f the BRDF times n·i, at λ = 10⁶ for roughness ≥ .3, n·o, n·z ≥ .1; exactly below 10⁻³."""
    alpha, lam, no, nz, oz = drawn(Domain(0.3, 0.1), count)
    kept = nz >= 0.1
    alpha, no, nz, oz = (t[kept] for t in (alpha, no, nz, oz))
    lam = torch.full_like(alpha, 1e6)
    expected = lobe_integral(lam) * brdf(alpha, nz, no, (no + nz) / torch.sqrt(2 + 2 * oz))
    return tail((each(operator, alpha, lam, no, nz, oz) - expected).abs() / (expected + lobe_integral(lam) / 100))


def scene(seed: int, points: int = 32, lobes: int = 6, sharpness=(0.0, 3.0)) -> tuple:
    """A light, a material and points that face the viewer at 60° or less, float64; sharpness from 10 to the power of its range."""
    g = torch.Generator().manual_seed(seed)

    def unit(count: int) -> Tensor:
        return torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1)

    light = SimpleNamespace(
        axis=unit(lobes),
        sharpness=torch.logspace(*sharpness, lobes, dtype=torch.float64),
        weight=torch.rand(lobes, 3, generator=g).double(),
    )
    material = SimpleNamespace(
        diffuse=torch.tensor([0.3, 0.2, 0.1]).double(),
        specular=torch.tensor([0.2, 0.3, 0.4]).double(),
        roughness=torch.tensor(0.4).double(),
    )
    normals = unit(points)
    return light, material, normals, torch.nn.functional.normalize(normals + 0.8 * unit(points), dim=1)


def with_changes(namespace, **changes):
    return SimpleNamespace(**(vars(namespace) | changes))


def turned(operator: Operator) -> tuple[float]:
    """Largest difference after everything was turned, over the largest radiance."""
    light, material, normals, views = scene(0)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)).double()).Q
    before = operator(light, material, normals, views)
    after = operator(with_changes(light, axis=light.axis @ turn.T), material, normals @ turn.T, views @ turn.T)
    return (float((after - before).abs().max() / before.max()),)


def scaled(operator: Operator, factor: float = 1e6) -> tuple[float]:
    """Largest relative difference between `factor` times the radiance and the radiance of weights times `factor`."""
    light, material, normals, views = scene(0)
    before = operator(light, material, normals, views).double()
    after = operator(with_changes(light, weight=factor * light.weight), material, normals, views).double()
    return (float(((after / factor - before).abs() / before.clamp_min(1e-12)).max()),)
