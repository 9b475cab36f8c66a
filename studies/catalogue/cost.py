"""Cost: how do time and memory grow with the entries of the matrix?

Varied     the full matrix of n materials in n lights, n = 3 … 40 (9 to 1,600 entries), of small spheres, so that the largest fits in
           memory and time; with the 6 lobes a light that they are made of, in one round, and as the solve is by default for the first of them.
Measured   processor time of the solve and memory of its process; the exponents of both over entries.
"""

from __future__ import annotations

from studies.core.cost import Sized
from studies.core.study import Claim, Scale, Setting, Study

SIDES = {"full": (3, 5, 10, 20, 40), "quick": (3, 5)}
BY_DEFAULT = {"full": (3, 5, 10), "quick": (3,)}
SHORT = {"lobes": 6, "insert": 6, "rounds": 1, "iterations": 4, "polish": 4}


def settings(scale: Scale) -> list[Setting]:
    """By entries; then as the solve is by default."""
    short, default = SIDES[scale.name], BY_DEFAULT[scale.name]
    return [
        *(
            Setting(f"{n * n}", f"6 lobes, {n * n:,}", x, lambda seed, n=n: Sized(seed, n, SHORT))
            for x, n in enumerate(short)
        ),
        *(
            Setting(f"default-{n * n}", f"by default, {n * n:,}", len(short) + x, lambda seed, n=n: Sized(seed, n))
            for x, n in enumerate(default)
        ),
    ]


def claims(scale: Scale) -> list[Claim]:
    """Whether an entry of the largest costs less or more; the exponents are notes (`studies.steps.cost.conclude`)."""
    least, most = (SIDES[scale.name][k] ** 2 for k in (0, -1))
    return [
        Claim(
            "seconds_an_entry",
            f"{most}",
            f"{least}",
            f"an entry of {most:,} costs less than one of {least}",
            paper=False,
        )
    ]


STUDY = Study(
    name="cost",
    title="Cost",
    question="How do time and memory grow with the entries of the matrix?",
    paper="Linear in the entries; 30 minutes for 5 × 5 on a Titan X, after 3 hours of training.",
    varied="most lobes of a light, entries of the matrix",
    measures=("seconds", "seconds_an_entry", "peak", "grown"),
    settings=settings,
    claims=claims,
    kind="cost",
)
