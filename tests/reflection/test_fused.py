"""The compiled networks, and the derivatives that their tape writes, are those of torch."""

import os
import platform
import shutil

import pytest
import torch

from factorlib.errors import InputError
from factorlib.reflection import fused, reflection_operator
from factorlib.reflection.operator import Operator
from tests.reflection.test_operators import grid

compiler = pytest.mark.skipif(shutil.which(os.environ.get("CC", "cc")) is None, reason="no C compiler")
OLDEST = "-march=x86-64-v3" if platform.machine() == "x86_64" else "-march=armv8-a"


@compiler
@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0])
def test_compiled_response_is_that_of_torch(roughness):
    operator = reflection_operator("network")
    assert all(operator.fused.values())
    point = grid(roughness, torch.float32, rows=331)
    compiled, plain = operator.response(*point), Operator.response(operator, *point)
    for field in compiled.__struct_fields__:
        a, b = getattr(compiled, field), getattr(plain, field)
        scale = b.abs() + (plain.diffuse if field.startswith("diffuse") else plain.specular) + 0.01 / point[1]
        error = (a - b).abs() / scale
        assert error.quantile(0.99) < 1e-4, field
        assert error.max() < 1e-2, field


@compiler
def test_the_value_alone_is_that_of_the_response_and_without_lobes_or_points_there_is_nothing():
    operator, point = reflection_operator("network"), grid(0.3, torch.float32, rows=77)
    response = operator.response(*point)
    torch.testing.assert_close(operator.specular(*point), response.specular, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(operator.diffuse(point[1], point[3]), response.diffuse, rtol=1e-4, atol=1e-7)
    for lobes, points in ((0, 3), (2, 0)):
        none = torch.ones(points, lobes)
        response = operator.response(torch.tensor(0.5), torch.ones(lobes), torch.ones(points), none, none)
        assert response.specular.shape == response.diffuse.shape == (points, lobes)


def test_without_a_compiler_torch_computes_the_same(monkeypatch):
    monkeypatch.setenv("FACTORLIB_FUSED", "0")
    operator = reflection_operator("network")
    assert not any(operator.fused.values())
    assert operator.response(*grid(0.5, torch.float32)).specular.isfinite().all()


def test_a_compiler_that_fails_is_said_and_torch_is_not_taken_instead(monkeypatch, tmp_path):
    """Which form runs is in the keys of steps: a form that nobody asked for would be kept as the other."""
    compiler = tmp_path / "cc"
    compiler.write_text('#!/bin/sh\ntest "$1" = --version || { echo out of order >&2; exit 1; }\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    fused.compiled.cache_clear()
    with pytest.raises(InputError, match="out of order") as caught:
        reflection_operator("network")
    assert "FACTORLIB_FUSED=0" in caught.value.cure
    fused.compiled.cache_clear()


@compiler
def test_the_bits_do_not_depend_on_the_instructions_that_the_compiler_may_use(monkeypatch):
    """The oldest processor with fused multiplication, and code without vectors, against this one's own."""
    layers = reflection_operator("network").layers["specular"]
    roughness, *point = grid(0.3, torch.float32, rows=40)
    found, own = [], fused.FLAGS
    for flags in (own, own.replace("-march=native", OLDEST), own.replace("-O3 -march=native", f"-O1 {OLDEST}")):
        monkeypatch.setattr(fused, "FLAGS", flags)
        fused.compiled.cache_clear()
        found.append(b"".join(t.numpy().tobytes() for t in fused.Fused("specular", layers)(float(roughness), *point)))
    fused.compiled.cache_clear()
    assert found[0] == found[1] == found[2]
