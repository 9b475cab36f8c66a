"""Errors of every operator against the reference: values |R − S| / (S + E/100), gradients |∂R − ∂S| / (|∂S| + S + E/100)."""

from __future__ import annotations

import torch
from torch import Tensor

from factorlib.reflection import Operator
from factorlib.reflection.accuracy import diffuse_table, quantiles, specular_table
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.samples import DiffuseSamples, Samples, specular_inputs

SLOPES = ("roughness", "log_sharpness", "no", "nz", "oz")


def specular_errors(operator: Operator, samples: Samples) -> dict:
    """Over all samples and by roughness, sharpness, cosine of the view and angle from the mirror direction."""
    a, lam, no, nz, oz = (t.to(operator.dtype) for t in samples.inputs())
    with torch.no_grad():
        value = operator.specular(a.sqrt()[:, None], lam[:, None], no, nz[:, None], oz[:, None])[:, 0].double()
    return of_finite(
        lambda kept: specular_table(
            ((value - samples.value) / samples.scale())[kept], *(t[kept] for t in samples.inputs())
        ),
        value,
    )


def diffuse_errors(operator: Operator, samples: DiffuseSamples) -> dict:
    with torch.no_grad():
        value = operator.diffuse(samples.sharpness[:, None].to(operator.dtype), samples.nz[:, None].to(operator.dtype))[
            :, 0
        ].double()
    error = (value - samples.value) / samples.scale()
    return of_finite(lambda kept: diffuse_table(error[kept], samples.sharpness[kept], samples.nz[kept]), value)


def of_finite(table, value: Tensor) -> dict:
    """The table of the samples whose value is finite, and how many are not, if any."""
    kept = value.isfinite()
    return (table(kept) if kept.any() else {}) | ({} if kept.all() else {"not finite": int((~kept).sum())})


def gradient_errors(operator: Operator, exact: list[Tensor], count: int) -> dict:
    """By input; exact: `gradients` of the reference for as many samples."""
    scale = exact[0] + lobe_integral(specular_inputs(count, 5)[1]) / 100
    found = gradients(operator, count)
    return {
        name: of_finite(lambda kept, f=f, e=e: quantiles(((f - e) / (e.abs() + scale))[kept]), f)
        for name, f, e in zip(SLOPES, found[1:], exact[1:], strict=True)
    }


def gradients(operator: Operator, count: int) -> list[Tensor]:
    """Value and derivatives of samples that share nothing, each a problem of one lobe and one point; float64."""
    alpha, sharpness, no, nz, oz = specular_inputs(count, 5)
    leaves = [
        t.to(operator.dtype)[:, None].clone().requires_grad_() for t in (alpha.sqrt(), sharpness.log(), no, nz, oz)
    ]
    value = operator.specular(leaves[0], leaves[1].exp(), *leaves[2:])
    return [t.detach()[:, 0].double() for t in (value, *torch.autograd.grad(value.sum(), leaves))]
