"""Fits of the priors on light and on materials: they find what data were drawn from, and name what they were made from."""

import csv
import hashlib

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.exr import write_rgb_exr
from factorlib.inference.model.material_prior import Classes
from factorlib.jsonfile import read_json
from factorlib.light.prior import LightPrior
from studies.measured import light_prior, material_classes
from studies.measured.light_prior import fit_prior, maps_in, mean_of, round_numbers
from tests.light.test_light import KNOWN
from tests.refusal import refusal


def drawn(prior: LightPrior, cells, count: int, seed: int = 0):
    """y of `count` maps, each of its own contrast."""
    rng = np.random.default_rng(seed)

    def one(k, mean):
        contrast = np.sqrt(prior.freedom[k] / rng.chisquare(prior.freedom[k], (count, 1)))
        return contrast * rng.normal(size=(count, len(cells))) @ np.linalg.cholesky(prior.covariance(k, cells)).T + mean

    return np.stack([one(k, mean) for k, mean in enumerate(mean_of(prior, cells))])


def test_a_fit_finds_the_prior_that_maps_were_drawn_from():
    cells = fibonacci_sphere(100)
    result = fit_prior(drawn(KNOWN, cells, 150), cells)
    for name, rtol in (("variance", 0.25), ("decay_deg", 0.25), ("nugget", 0.3), ("level", 0.5), ("freedom", 0.4)):
        np.testing.assert_allclose(getattr(result, name), getattr(KNOWN, name), rtol=rtol)
    np.testing.assert_allclose(result.profile, KNOWN.profile, atol=0.15)


def test_the_table_says_what_it_was_made_from_and_how_good_it_is(tmp_path, monkeypatch):
    """Of three maps, brighter above; a folder without any is named."""
    monkeypatch.setattr(light_prior, "CELLS", 25)
    rng, folder = np.random.default_rng(1), tmp_path / "maps"
    folder.mkdir()
    for name in "abc":
        logs = np.linspace(1, -1, 16)[:, None, None] + 0.5 * rng.normal(size=(16, 32, 3))
        write_rgb_exr(folder / f"{name}.exr", np.exp(logs))
    light_prior.main([folder], tmp_path / "table.json")
    prior = msgspec.convert(read_json(tmp_path / "table.json"), LightPrior)
    assert [source.name for source in prior.made_from] == ["a.exr", "b.exr", "c.exr"] and prior == round_numbers(prior)
    assert prior.made_from[0].sha256 == hashlib.sha256((folder / "a.exr").read_bytes()).hexdigest()
    assert prior.profile[0][0] > 0.5 and np.isfinite(prior.leave_one_out.prior)
    refusal("no .hdr or .exr", maps_in, [tmp_path])


def test_classes_are_fitted_to_a_table(tmp_path):
    """Of five plastics, five steels, five felts."""
    rng, file, out = np.random.default_rng(0), tmp_path / "measured.csv", tmp_path / "classes.json"
    with file.open("w", newline="") as written:
        rows = csv.writer(written)
        rows.writerow(material_classes.COLUMNS)
        for name, level, roughness in (("plastic", 0.03, 0.3), ("steel", 0.1, 0.2), ("felt", 0.2, 0.8)):
            for k in range(5):
                factor = np.exp(0.1 * rng.normal())
                rows.writerow([f"{name}-{k}", *[level * factor] * 4, roughness + 0.01 * k, *[0.1] * 3])
    material_classes.main(file, out)
    classes = msgspec.convert(read_json(out), Classes)
    assert classes == material_classes.classes_of(file) and classes.made_from == "measured.csv"
    assert [(one.name, one.share) for one in classes.classes] == [(n, 0.333) for n in ("dielectric", "metal", "fabric")]
    for one, level, roughness in zip(classes.classes, (0.03, 0.1, 0.2), (0.32, 0.22, 0.82), strict=True):
        assert one.mean == pytest.approx((np.log(level), roughness), abs=0.15)
        assert one.tint == 0
