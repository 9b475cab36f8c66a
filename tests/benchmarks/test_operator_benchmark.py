"""The benchmark's figures and tables; what it measures is not repeated here."""

import xml.etree.ElementTree as ET

import pytest

from benchmarks.markdown import refresh, table
from benchmarks.operator.figures import QUANTITIES, errors_by_input, time_against_error
from benchmarks.operator.stability import DOCS
from benchmarks.operator.tables import SLOPES, as_tables
from benchmarks.rounded import exact
from factorlib.errors import InputError

ERROR = {"median": 0.001, "p95": 0.02, "p99": 0.1, "worst": 3.0, "samples": 7}


def result() -> dict:
    bins = {quantity: {"0 to 1": ERROR, "1 to 2": ERROR} for quantity in QUANTITIES}
    row = {"specular": ERROR | bins, "diffuse": ERROR, "gradients": dict.fromkeys(SLOPES, ERROR)}
    time = {name: {"least": 0.3, "median": 0.4} for name in ("values", "values_and_gradients")}
    labels = ("closed_form float32", "another float32", "another float32 torch", "reference 10⁻²")
    return {
        "operators": {label: row | {"microseconds": time} for label in labels},
        "bfloat16": {"another": row | {"specular": {"not finite": 3}}},
    }


def test_figures_are_whole_for_any_operators():
    for figure in (time_against_error(result()["operators"]), errors_by_input(result()["operators"])):
        ET.fromstring(figure)
        assert "another" in figure and "nan" not in figure


def test_every_table_has_its_place_and_the_rest_stays(tmp_path):
    tables = as_tables(result()) | dict.fromkeys(("stability", "special values", "laws"), "x")
    text = DOCS.read_text(encoding="utf-8")
    page = tmp_path / "operator.md"
    page.write_text(text, encoding="utf-8")
    refresh(page, tables)
    once = page.read_text(encoding="utf-8")
    assert all(inner in once for inner in tables.values()) and "## Stability" in once
    refresh(page, tables)
    assert page.read_text(encoding="utf-8") == once
    with pytest.raises(InputError, match="no place for the table 'other'"):
        refresh(page, {"other": ""})


def test_numbers_are_short():
    assert [exact(v) for v in (0.00099999, 0.0123, 1.0, 250.0, 1e-6, 64000.0)] == [
        ".001",
        ".012",
        "1",
        "250",
        "1.0·10⁻⁶",
        "6.4·10⁴",
    ]
    assert table(["a", "b"], [["x", "1"]]).splitlines()[1] == "|---|---:|"
