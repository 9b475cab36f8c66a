"""How long the parts of this project are, in lines of Python, beside what they may be at most: `make size`."""

from studies.measured.tools import ROOT, table

CENTRE = [f"factorlib/{name}" for name in ("solve", "model", "diagnose", "light")]
LONE = ("__main__", "setup", "lock", "wholefile", "disk", "yamlfile", "reading")
MACHINE = ["factorlib/runner", *(f"factorlib/{name}.py" for name in LONE)]
PARTS = {
    "solve, model, diagnose, light": (CENTRE, 3600),
    "what plans, runs, stores, sets up and speaks to the terminal": (MACHINE, 3000),
    "the rest of factorlib, and stages": (["factorlib", "stages"], 13300),
    "studies": (["studies"], 5500),
    "tests": (["tests"], 13600),
}


def lines(path: str) -> int:
    """Lines of a module, or of all modules below a folder."""
    files = [ROOT / path] if path.endswith(".py") else sorted((ROOT / path).rglob("*.py"))
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


if __name__ == "__main__":
    counts = {part: sum(map(lines, paths)) for part, (paths, _) in PARTS.items()}
    counts["the rest of factorlib, and stages"] -= sum(list(counts.values())[:2])
    rows = [[part, f"{count:,}", f"{PARTS[part][1]:,}"] for part, count in counts.items()]
    print(table(["part", "lines", "at most"], [*rows, ["all", f"{sum(counts.values()):,}", "39,000"]]))
