"""The tables of the solve's benchmark."""

from benchmarks.solve.tables import as_tables


def row(label_share=None):
    worst = {"mean": 0.02, "worst": 0.05}
    points = [{"wall": w, "processor": 2 * w, "mean_db": db} for w, db in ((3.0, 30.0), (9.0, 43.0), (20.0, 44.0))]
    share = {} if label_share is None else {"share": label_share}
    psnr = {"psnr": {"mean": 44.0, "worst": 38.0}}
    return {"resynthesis": psnr, "materials": {k: worst for k in ("diffuse", "specular", "roughness")}, "points": points} | share


def test_tables_say_when_a_level_was_reached_and_on_how_much():
    times = {"100": 5.0, "9": 1.0}
    scaling = {"entries": {n: {"wall": t, "processor": t} for n, t in times.items()}, "exponent": {"wall": 0.67, "processor": 0.67}}
    tables = as_tables({"sets": {"3x3": {"solvers": {"bundle": row(), "paper": row(0.1)}}}, "scaling": scaling})
    assert "| 3x3 | bundle | 9, 18 | not reached |" in tables["levels"]
    assert "paper, on 10%" in tables["ends"] and "44.0, 38.0" in tables["ends"]
    assert tables["scaling"].index("| 9 |") < tables["scaling"].index("| 100 |")
    assert as_tables({"sets": {}})["scaling"] == "Not run."
