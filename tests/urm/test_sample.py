"""The sample of many observations: bounded, without chance, and standing for all of them."""

import msgspec
import numpy as np
import pytest

from factorlib.urm.merge import merge
from factorlib.urm.observations import COLUMNS, Observations
from factorlib.urm.sample import sample, strata
from tests.urm.test_urm import observations


def many(n: int = 20_000, seed: int = 0) -> Observations:
    """A flat seat that most pixels show, and a ball that few do; a fifth of the ball's are clipped."""
    random = np.random.default_rng(seed)
    normal = np.tile([0.0, -0.6, -0.8], (n, 1))
    ball = random.normal(size=(n // 20, 3)) * (1, 1, 0.5) - (0, 0, 2)
    normal[: n // 20] = ball / np.linalg.norm(ball, axis=1, keepdims=True)
    clipped = np.zeros((n, 3), bool)
    clipped[: n // 100] = True
    y, x = np.divmod(np.arange(n), 200)
    order = random.permutation(n)
    return Observations(
        normal=normal[order].astype("f4"), view=np.tile([0.0, 0.0, -1.0], (n, 1)).astype("f4"),
        radiance=random.uniform(0.5, 1.5, (n, 3)),
        clipped=clipped[order], material=(np.arange(n) % 2)[order].astype("i2"), photo=np.zeros(n, "i4"),
        illumination=np.zeros(n, "i4"),
        x=x.astype("i4"), y=y.astype("i4"), weight=random.uniform(0.1, 1, n).astype("f4"),
        materials=("red", "white"), photos=("a",), illuminations=("a",), exposures=(0.5,),
    )  # fmt: skip


def test_no_more_than_that_many_are_no_sample():
    seen = many(2000)
    assert sample(seen, 2000) is seen and sample(seen, 10**9) is seen


@pytest.mark.parametrize("most", [5000, 1500, 100])
def test_there_are_as_many_as_asked_for(most):
    assert len(sample(many(), most)) == most


def test_weights_keep_their_sum_in_every_stratum_and_in_all():
    seen = many()
    kept = sample(seen, 3000)
    assert kept.weight.sum(dtype=float) == pytest.approx(seen.weight.sum(dtype=float), rel=1e-5)
    for material in (0, 1):
        for clipped in (False, True):
            total = [
                s.weight[(s.material == material) & (s.clipped[:, 0] == clipped)].sum(dtype=float) for s in (seen, kept)
            ]
            assert total[1] == pytest.approx(total[0], rel=1e-5)


def test_rare_normals_are_all_kept_and_the_flat_seat_is_thinned():
    seen = many()
    kept = sample(seen, 3000)
    flat = [np.abs(s.normal - np.float32([0, -0.6, -0.8])).max(1) < 1e-6 for s in (seen, kept)]
    assert (~flat[1]).sum() == (~flat[0]).sum() == 1000
    assert flat[1].sum() <= 2000 and (kept.weight[~flat[1]] == seen.weight[~flat[0]]).all()


def test_the_sample_is_spread_over_the_picture_and_the_same_each_time():
    seen = many()
    kept, again = sample(seen, 3000), sample(many(), 3000)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(kept, name), getattr(again, name))
    assert (np.diff(kept.y * 200 + kept.x) > 0).all(), "in row order"
    share = np.histogram(kept.y, 10, (0, 100))[0] / len(kept)
    assert share.min() > 0.08 and share.max() < 0.12


def test_the_mean_of_a_stratum_is_kept_within_its_noise():
    seen = many()
    kept = sample(seen, 3000)
    group, small = strata(seen, 3000), strata(kept, 3000)
    most = np.bincount(group).argmax()
    means = [
        np.average(s.radiance[g == n], axis=0, weights=s.weight[g == n])
        for s, g, n in ((seen, group, most), (kept, small, np.bincount(small).argmax()))
    ]
    np.testing.assert_allclose(*means, atol=0.04)


def test_names_exposures_and_the_rest_stay():
    visibility = np.random.default_rng(1).integers(0, 256, (20_000, 8)).astype(np.uint8)
    seen = msgspec.structs.replace(many(), visibility=visibility)
    kept = sample(seen, 3000)
    assert (kept.materials, kept.photos, kept.exposures) == (seen.materials, seen.photos, seen.exposures)
    row = kept.y * 200 + kept.x
    for name in ("visibility", "radiance"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(seen, name)[row])


def test_a_sampled_ball_merges_to_what_the_whole_ball_merges_to():
    seen = observations()
    whole, part = merge(seen, 20.0), merge(sample(seen, len(seen) // 2), 20.0)
    assert part.weight.sum(dtype=float) == pytest.approx(whole.weight.sum(dtype=float), rel=1e-5)
    assert len(part) > 0.9 * len(whole)
