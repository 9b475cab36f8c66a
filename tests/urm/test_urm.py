"""Observations of photos: which pixels, in files, one after another, merged, sampled, and brought to one exposure."""

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import BINS, NO_OCCLUDER
from factorlib.urm.extract import PhotoSource, extract_observations
from factorlib.urm.observations import (
    COLUMNS,
    OPTIONAL,
    Observations,
    at_one_exposure,
    concatenate,
    read_observations,
    relative_exposures,
    write_observations,
)
from factorlib.urm.reduction import merge, sample
from tests.refusal import refusal


def photo_and_geometry(size=64):
    """A unit sphere seen from the front by a distant camera: normals are known by hand."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    inside = x**2 + y**2 < 0.98
    z = -np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    one = inside.astype("f4")
    label = np.where(x < 0, 1, 2) * one
    vectors = {"normal": (x * one, y * one, z * one), "view": (0 * one, 0 * one, -one)}
    geometry = {f"{name}.{axis}": v for name, vector in vectors.items() for axis, v in zip("xyz", vector)}
    geometry |= {"label": label, "depth": (4 + z) * one, "confidence": one, "object": one}
    photo = {"R": 1 + x, "G": 1 + y, "B": np.ones_like(x), "label": label, "valid": one}
    photo |= {f"clipped.{c}": (y < -0.8) * one for c in "RGB"}
    return photo, geometry


def observations(name="kitchen", illumination="kitchen", **changed):
    photo, geometry = photo_and_geometry()
    return extract_observations({**photo, **changed}, geometry, PhotoSource(name, illumination), ("red", "white"))


def test_a_pixel_is_observed_where_mask_and_mesh_agree():
    photo, _ = photo_and_geometry()
    everything = observations()
    swapped = observations(label=np.where(photo["label"] == 1, 2, photo["label"]))
    invalid = observations(valid=np.zeros_like(photo["label"]))
    assert set(everything.material) == {0, 1}
    assert set(swapped.material) == {1}
    assert len(invalid) == 0


def test_what_faces_away_or_grazes_is_not_observed():
    observed = observations()
    assert (np.sum(observed.normal * observed.view, -1) > 0.05).all()


def with_columns(name="kitchen", count=64):
    """Observations with every column that need not be there; what hides directions is of material 0 or 1."""
    observed, random = observations(name, name), np.random.default_rng(0)
    visibility = (random.integers(0, 2, (len(observed), count)) * 255).astype(np.uint8)
    codes = np.where(visibility == 0, random.integers(0, 2 * BINS, visibility.shape), NO_OCCLUDER).astype(np.uint16)
    sure = np.linspace(0, 1, len(observed)).astype("f4")
    return msgspec.structs.replace(observed, visibility=visibility, occluder=codes, confidence=sure, exposures=(2.0,))


@pytest.mark.parametrize("make", [with_columns, observations])
def test_parquet_gives_back_what_was_written_and_the_same_bytes(tmp_path, make):
    observed = make()
    write_observations(tmp_path / "a.parquet", observed)
    write_observations(tmp_path / "b.parquet", read_observations(tmp_path / "a.parquet"))
    again = read_observations(tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    for name in (*COLUMNS, *OPTIONAL):
        np.testing.assert_array_equal(getattr(again, name), getattr(observed, name).astype(getattr(again, name).dtype))
    for name in ("visibility", "occluder"):
        np.testing.assert_array_equal(getattr(again, name), getattr(observed, name))
    known = tuple(exposure for exposure in observed.exposures if exposure)
    assert (again.materials, again.photos, again.exposures) == (("red", "white"), ("kitchen",), known)


@pytest.mark.parametrize("key, change", [
    ("'confidence' has a value outside 0 to 1", lambda observed: {"confidence": observed.confidence + 0.5}),
    ("'confidence' has a value outside 0 to 1", lambda observed: {"confidence": observed.confidence * np.nan}),
    ("'place' has a value that is not finite", lambda observed: {"place": observed.place * np.nan}),
    ("met", lambda observed: {"occluder": observed.occluder * 0 + 2 * BINS}), ("met", lambda observed: {"occluder": observed.occluder[:, :32]}),
])  # fmt: skip
def test_values_that_mean_nothing_are_refused(tmp_path, key, change):
    observed = with_columns()
    write_observations(tmp_path / "a.parquet", msgspec.structs.replace(observed, **change(observed)))
    refusal(key, read_observations, tmp_path / "a.parquet")


@pytest.mark.parametrize("degrees", [3.0, 10.0])
def test_merging_keeps_weight_and_mean_and_moves_normals_by_less_than_a_cell(degrees):
    observed = observations()
    merged = merge(observed, degrees)
    assert len(merged) < len(observed)
    np.testing.assert_allclose(merged.weight.sum(), observed.weight.sum(), rtol=1e-5)
    for m in range(2):  # per material: groups never mix materials
        of_m, of_m_merged = observed.material == m, merged.material == m
        total = (merged.radiance * merged.weight[:, None])[of_m_merged].sum(0)
        np.testing.assert_allclose(total, (observed.radiance * observed.weight[:, None])[of_m].sum(0), rtol=1e-4)
    clipped_weight = merged.weight[merged.clipped[:, 0]].sum()  # nor do they mix clipped with unclipped
    np.testing.assert_allclose(clipped_weight, observed.weight[observed.clipped[:, 0]].sum(), rtol=1e-5)
    nearest = np.arccos(np.clip((observed.normal @ merged.normal.T).max(1), -1, 1))
    assert np.degrees(nearest.max()) < 1.5 * degrees
    np.testing.assert_allclose(np.linalg.norm(merged.normal, axis=1), 1, atol=1e-5)


def test_merging_takes_weighted_means_and_the_codes_of_the_first():
    observed = with_columns()
    observed = msgspec.structs.replace(
        observed, weight=np.random.default_rng(0).uniform(0.1, 1, len(observed)).astype("f4")
    )
    merged = merge(observed, 8.0)
    for name, tolerance in (("visibility", 2e-3), ("confidence", 1e-5), ("radiance", 1e-4)):
        sums = (np.dot(each.weight.astype(float), getattr(each, name)) for each in (merged, observed))
        np.testing.assert_allclose(*sums, rtol=tolerance)
    first = [
        int(np.flatnonzero((observed.x == x) & (observed.y == y))[0]) for x, y in zip(merged.x, merged.y, strict=True)
    ]
    np.testing.assert_array_equal(merged.occluder, observed.occluder[first])
    assert 0 <= merged.confidence.min() and merged.confidence.max() <= 1 and merged.exposures == observed.exposures


def exposed(name, illumination, exposure):
    return msgspec.structs.replace(observations(name, illumination), exposures=(exposure,))


def test_photos_of_one_light_are_brought_to_the_exposure_of_its_first():
    observed = concatenate([exposed("c", "room", 8.0), exposed("a", "room", 2.0), exposed("b", "garden", 5.0)])
    relative = relative_exposures(observed)
    assert relative == {"a": 1.0, "b": 1.0, "c": 4.0}
    same = at_one_exposure(observed, relative)
    of_c = observed.photo == observed.photos.index("c")
    np.testing.assert_allclose(same.radiance[of_c], observed.radiance[of_c] / 4)
    np.testing.assert_array_equal(same.radiance[~of_c], observed.radiance[~of_c])


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


def test_weights_keep_their_sum_in_every_stratum_and_in_all():
    observed = many()
    sampled = sample(observed, 3000)
    assert sampled.weight.sum(dtype=float) == pytest.approx(observed.weight.sum(dtype=float), rel=1e-5)
    for material in (0, 1):
        for clipped in (False, True):
            total = [
                s.weight[(s.material == material) & (s.clipped[:, 0] == clipped)].sum(dtype=float)
                for s in (observed, sampled)
            ]
            assert total[1] == pytest.approx(total[0], rel=1e-5)


def test_rare_normals_are_all_kept_and_the_flat_seat_is_thinned():
    observed = many()
    sampled = sample(observed, 3000)
    flat = [np.abs(s.normal - np.float32([0, -0.6, -0.8])).max(1) < 1e-6 for s in (observed, sampled)]
    assert (~flat[1]).sum() == (~flat[0]).sum() == 1000
    assert flat[1].sum() <= 2000 and (sampled.weight[~flat[1]] == observed.weight[~flat[0]]).all()


def test_a_cell_of_zero_merges_nothing():
    observed = observations()
    assert merge(observed, 0.0) is observed
