"""The stage on small real artifacts: with truth, without, and with one photo of one material."""

import math

import msgspec
import pytest

from factorlib.jsonfile import read_json
from factorlib.results.metrics import Metrics
from factorlib.stage import silent
from stages import evaluate
from tests.evaluate.made_artifacts import Made, make_artifacts

LINKED = {"day": ["red", "white"], "noon": ["white", "brass"], "dusk": ["red"]}


def numbers_in(value) -> list[float]:
    """Every number of nested plain containers."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    return [value] if isinstance(value, int | float) else [number for each in inside for number in numbers_in(each)]


def metrics_of(folder, **made) -> dict:
    return evaluated(make_artifacts(Made(folder / "in", **made)), folder / "out")


def evaluated(inputs, out) -> dict:
    out.mkdir()
    evaluate.main(evaluate.Params(), inputs, out, silent)
    return read_json(out / "metrics.json")


@pytest.fixture(scope="module")
def linked(tmp_path_factory):
    return metrics_of(tmp_path_factory.mktemp("linked"), seen=LINKED)


def test_every_part_is_scored_beside_its_null_in_finite_numbers(linked):
    msgspec.convert(linked, Metrics)
    numbers = numbers_in(linked)
    assert len(numbers) > 500 and all(map(math.isfinite, numbers)) and linked["reasons"] == {}
    assert linked["set"] == {"photos": 3, "materials": 3, "illuminations": 3, "components": 1}
    mean = linked["resynthesis"]["mean"]["none"]
    assert mean["estimate"]["psnr_tonemapped_db"] > mean["null"]["psnr_tonemapped_db"] + 10
    relit = linked["relit_set"]
    assert relit["pairs"] == 9 and relit["mean_psnr_db"] >= relit["worst_psnr_db"] > relit["null_mean_psnr_db"] + 5
    assert linked["light"]["mean"]["scalar_per_set"]["mirror"]["estimate"]["rmse"] < 1e-3  # only scaled, by 1.1
    assert linked["normals"]["day"]["estimate"]["median_deg"] < 0.1 < linked["normals"]["day"]["null"]["median_deg"]
    assert linked["poses"]["dusk"]["balls"]["rotation_deg"] == pytest.approx(0)


def test_without_truth_re_synthesis_remains_and_the_rest_says_why(tmp_path):
    found = metrics_of(tmp_path, seen={"only": ["red"]}, truth=False)
    assert found["materials"] is found["light"] is found["relighting"] is found["relit_set"] is None
    assert set(found["reasons"].values()) == {evaluate.NO_TRUTH}
    assert found["resynthesis"]["mean"]["none"]["estimate"]["psnr_linear_db"] > 20
    assert found["verdict"]["trust"] == "good"
    assert (tmp_path / "out" / "verdict.txt").read_text().startswith("good: relit pictures are expected to reach ")
