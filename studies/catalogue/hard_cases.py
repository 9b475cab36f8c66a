"""Hard cases: what becomes of the operator, the solve and alignment where each is hardest?

Varied     the cases of docs/operator.md, docs/solve.md and docs/align.md; seeds are of noise and of poses.
Measured   the errors of those tables; the worst are named below the figure.
"""

from __future__ import annotations

from studies.core.hard import CASES, Hard
from studies.core.study import Claim, Scale, Setting, Study

QUICK = {"operator": CASES["operator"][:4], "solve": CASES["solve"][:1] + CASES["solve"][16:17], "align": ("exact",)}


def settings(scale: Scale) -> list[Setting]:
    """Table by table."""
    tables = QUICK if scale.name == "quick" else CASES
    rows = [(table, name) for table, names in tables.items() for name in names]
    return [_setting(x, table, name, 1 if scale.name == "quick" else 99) for x, (table, name) in enumerate(rows)]


def _setting(x: int, table: str, name: str, shapes: int) -> Setting:
    number = CASES[table].index(name)
    return Setting(f"{table}-{number}", f"{table}: {name}", x, lambda seed: Hard(seed, table, name, shapes))


def claims(scale: Scale) -> list[Claim]:
    """None: cases are not compared with each other."""
    return []


STUDY = Study(
    name="hard-cases",
    title="Hard cases",
    question="What becomes of the operator, the solve and alignment where each is hardest?",
    paper="Nothing.",
    varied="case",
    measures=(
        "of_bound",
        "value_error",
        "wrong_poses",
        "undoubted",
        "hard_k",
        "hard_roughness",
        "hard_radiance",
        "gradient_rounding",
        "normal_error",
    ),
    settings=settings,
    claims=claims,
    kind="hard",
)
