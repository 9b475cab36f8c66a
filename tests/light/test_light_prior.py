"""The command that fits the prior on natural light: what it writes, and what it says of folders and maps that will not do."""

import hashlib

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from factorlib import light_prior
from factorlib.images.exr import write_rgb_exr
from factorlib.light.prior import read_light_prior

COUNT = 25


@pytest.fixture
def folder(tmp_path):
    """Three maps, brighter above."""
    rng = np.random.default_rng(1)
    (tmp_path / "maps").mkdir()
    for name in "abc":
        logs = np.linspace(1, -1, 16)[:, None, None] + 0.5 * rng.normal(size=(16, 32, 3))
        write_rgb_exr(tmp_path / f"maps/{name}.exr", np.exp(logs))
    return tmp_path / "maps"


@pytest.fixture
def run(monkeypatch):
    monkeypatch.setattr(light_prior, "CELLS", COUNT)
    app = typer.Typer()
    app.command()(light_prior.main)
    return lambda *words: CliRunner().invoke(app, list(map(str, words)))


def test_the_table_says_what_it_was_made_from_and_how_good_it_is(folder, run, tmp_path):
    done = run(folder, "--out", tmp_path / "table.json")
    assert done.exit_code == 0, done.output
    prior = read_light_prior(tmp_path / "table.json")
    assert [source.name for source in prior.made_from] == ["a.exr", "b.exr", "c.exr"]
    assert prior.made_from[0].sha256 == hashlib.sha256((folder / "a.exr").read_bytes()).hexdigest()
    assert f"this prior {prior.leave_one_out.prior:.1f}" in done.output and f"{COUNT} cells" in done.output
    assert prior.profile[0][0] > 0.5
    assert '"decay_deg"' in run(folder).output


def test_folders_that_hold_no_map_are_named(tmp_path, run):
    for place, said in ((tmp_path / "nowhere", "no such folder"), (tmp_path, "no .hdr or .exr")):
        done = run(place)
        assert done.exit_code == 2 and said in done.output and place.name in done.output
