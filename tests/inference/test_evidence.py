"""The standard by which models are compared: laws of (1), and how rarely chance passes it."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.inference.materials import Point
from factorlib.inference.model_selection import (
    CLEARLY_AGAINST,
    CLEARLY_FOR,
    LEAST_LOSS,
    Losses,
    compare_models,
    held_out_losses,
)
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import none_held_out
from tests.inference.made_lights import photographed


def made(seed: int, lights: int, gain: float = 0.0, rows: int = 60, clusters_of: int = 12) -> tuple[Losses, Losses]:
    """Squared residuals of two models, the richer better by a factor 1 + gain; a light each with its own scale."""
    rng, without, richer, clusters = np.random.default_rng(seed), [], [], []
    for _ in range(lights):
        number = rng.integers(0, clusters_of, rows)
        shared, scale = rng.chisquare(3, clusters_of)[number], rng.lognormal(0, 1)
        both = [scale * (shared + rng.chisquare(2, rows)) / factor for factor in (1.0, 1 + gain)]
        without.append(both[0])
        richer.append(both[1])
        clusters.append(np.unique(number, return_inverse=True)[1])
    return Losses(without, clusters), Losses(richer, clusters)


ANY = {"seed": st.integers(0, 10_000), "lights": st.integers(1, 5), "gain": st.floats(-0.5, 2)}
FEW_EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True)


@FEW_EXAMPLES
@given(**ANY, factor=st.floats(0.5, 1000))
def test_models_swapped_change_the_sign_and_the_order_of_lights_and_the_scale_of_a_light_nothing(factor, **how):
    without, richer = made(**how)
    one, other = compare_models(without, richer, CLEARLY_FOR), compare_models(richer, without, CLEARLY_FOR)
    assert one.margin == pytest.approx(-other.margin, rel=1e-9, abs=1e-9)
    assert one.held_out_loss_with == other.held_out_loss_without
    assert one.held_out_loss_without == other.held_out_loss_with

    def scaled(losses, which):
        return Losses([factor * v if k in which else v for k, v in enumerate(losses.values)], losses.clusters)

    turned = (Losses(losses.values[::-1], losses.clusters[::-1]) for losses in (without, richer))
    assert compare_models(*turned, CLEARLY_FOR).margin == pytest.approx(one.margin, rel=1e-9)
    for which in ({0}, set(range(5))):
        result = compare_models(scaled(without, which), scaled(richer, which), CLEARLY_FOR).margin
        assert result == pytest.approx(one.margin, rel=0.01, abs=1e-3)


@pytest.mark.parametrize("lights", [1, 3])
def test_no_gain_is_no_evidence_either_way(lights):
    same, _ = made(0, lights)
    result = compare_models(same, same, CLEARLY_FOR)
    assert not result.accepted and result.margin == 0 and compare_models(same, same, CLEARLY_AGAINST).accepted


def test_nothing_held_out_decides_nothing():
    nothing, (one, better) = np.zeros(0), made(0, 1, gain=1.0)
    numbers = nothing.astype(int)
    for least in (CLEARLY_FOR, CLEARLY_AGAINST):
        result = compare_models(Losses([nothing], [numbers]), Losses([nothing], [numbers]), least)
        assert not result.accepted and result.margin is None and result.held_out_loss_with is None
    both = [Losses([nothing, *of.values], [numbers, *of.clusters]) for of in (one, better)]
    assert compare_models(*both, CLEARLY_FOR).margin == pytest.approx(compare_models(one, better, CLEARLY_FOR).margin)


@pytest.mark.parametrize("lights, clusters", [(3, 12), (1, 3)])
def test_chance_is_rarely_evidence_though_residuals_are_alike(lights, clusters):
    """Of one distribution more than two standard errors are found about one time in forty; each by its own, not by clusters, far more often."""
    kept, singly = [], []
    for seed in range(400):
        rng, (same, _) = np.random.default_rng(seed), made(seed, lights, rows=240, clusters_of=clusters)
        err = [
            np.exp(0.3 * rng.normal(size=(2, clusters))) for _ in same.values
        ]  # alike within a cluster, not between models
        both = [
            Losses([v * e[k][c] for v, e, c in zip(same.values, err, same.clusters, strict=True)], same.clusters)
            for k in (0, 1)
        ]
        kept.append(compare_models(*both, CLEARLY_FOR).accepted)
        alone = [Losses(of.values, [np.arange(len(v)) for v in of.values]) for of in both]
        singly.append(compare_models(*alone, CLEARLY_FOR).accepted)
    assert np.mean(kept) < 0.05 and np.mean(singly) > 3 * np.mean(kept), (np.mean(kept), np.mean(singly))


def test_each_light_counts_relative_to_itself():
    """The third light is explained badly, and a little worse by the richer model: its sum would outweigh what the others gain."""
    one, other = np.array([0.5, 1.5]), np.array([1.0, 2.0, 3.0, 2.0])
    without, richer = [one, one, 100 * other], [one / 2, one / 2, 101 * other]
    assert sum(losses.sum() for losses in richer) > sum(losses.sum() for losses in without)
    numbers = [np.arange(len(v)) for v in without]
    result = compare_models(Losses(without, numbers), Losses(richer, numbers), CLEARLY_FOR)
    assert (
        result.accepted and not compare_models(Losses(richer, numbers), Losses(without, numbers), CLEARLY_FOR).accepted
    )
    logarithms = np.log([[1, 1, 200], [0.5, 0.5, 202]]) @ [0.25, 0.25, 0.5]  # by their counts
    np.testing.assert_allclose([result.held_out_loss_without, result.held_out_loss_with], np.exp(logarithms), rtol=1e-3)
    exact, numbers = np.full(5, 1e-9), [np.arange(5)]
    noisy = exact * np.array([1.0, 2.0, 3.0, 1.0, 2.0])
    assert (
        compare_models(Losses([2 * noisy], numbers), Losses([noisy], numbers), CLEARLY_FOR).held_out_loss_with
        < 2 * LEAST_LOSS
    )


def test_losses_are_those_of_held_out_observations_or_of_all():
    problem, true = photographed(0, 2, cells=30, size=8)
    for some in (problem, problem.with_blocks([none_held_out(b) for b in problem.blocks])):
        result = held_out_losses(some, Point(MATERIALS, true))
        for values, clusters, block in zip(result.values, result.clusters, some.blocks, strict=True):
            assert len(values) == len(clusters) == (block.held_out.sum() or len(block))
    worse = msgspec.structs.replace(MATERIALS, diffuse=2 * MATERIALS.diffuse)
    richer, without = (held_out_losses(problem, Point(materials, true)) for materials in (MATERIALS, worse))
    assert compare_models(without, richer, CLEARLY_FOR).accepted
