"""Structure: which links between photos matter?

Varied     which entries of the n × n matrix are observed:
           full        all n²
           loop        2n: entries (i, i) and (i, i + 1), closed
           star        2n − 1: one material in all lights, one light with all materials
           link        2n − 1: the diagonal, and one material in all lights
           random      2n − 1 at random, another choice for each seed, every material and every light among them
           diagonal    n: no link at all
Measured   all entries, and those that were not observed: the materials and lights of entries that no photo showed together.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from studies.core.entries import Entry
from studies.core.study import Claim, Scale, Setting, Study, full_matrix


def loop(n: int, seed: int) -> list[Entry]:
    """
    >>> loop(3, 0)
    [(0, 0), (0, 1), (1, 1), (1, 2), (2, 0), (2, 2)]
    """
    return sorted({entry for i in range(n) for entry in ((i, i), (i, (i + 1) % n))})


def star(n: int, seed: int) -> list[Entry]:
    """
    >>> star(3, 0)
    [(0, 0), (0, 1), (0, 2), (1, 0), (2, 0)]
    """
    return sorted({entry for i in range(n) for entry in ((0, i), (i, 0))})


def link(n: int, seed: int) -> list[Entry]:
    """
    >>> link(3, 0)
    [(0, 0), (0, 1), (0, 2), (1, 1), (2, 2)]
    """
    return sorted({entry for i in range(n) for entry in ((0, i), (i, i))})


def random(n: int, seed: int) -> list[Entry]:
    """As many as a star has; drawn again until each material and each light is among them."""
    rng, every = Random(seed), full_matrix(n, n)
    while True:
        drawn = sorted(rng.sample(every, 2 * n - 1))
        if len({m for m, _ in drawn}) == len({li for _, li in drawn}) == n:
            return drawn


def diagonal(n: int, seed: int) -> list[Entry]:
    """
    >>> diagonal(2, 0)
    [(0, 0), (1, 1)]
    """
    return [(i, i) for i in range(n)]


def full(n: int, seed: int) -> list[Entry]:
    """All."""
    return full_matrix(n, n)


PATTERNS: dict[str, Callable[[int, int], list[Entry]]] = {
    "full": full, "loop": loop, "star": star, "link": link, "random": random, "diagonal": diagonal,
}  # fmt: skip


def settings(scale: Scale) -> list[Setting]:
    """A pattern each."""
    return [_setting(scale, x, name) for x, name in enumerate(PATTERNS)]


def _setting(scale: Scale, x: int, name: str) -> Setting:
    n, pattern = scale.largest, PATTERNS[name]
    named = f"{n}x{n}" if name == "full" else f"{name}-{n}"  # the full matrix is the same case in other studies
    return Setting(named, name, x, lambda seed: scale.case(seed, pattern(n, seed)))


def claims(scale: Scale) -> list[Claim]:
    """Links against none, and kinds of links against each other."""
    n = scale.largest
    return [
        Claim("unobserved", f"link-{n}", f"diagonal-{n}", "a linking material helps unconnected pairs", paper=False),
        Claim("unobserved", f"loop-{n}", f"diagonal-{n}", "a loop helps unconnected pairs", paper=False),
        Claim(
            "unobserved",
            f"link-{n}",
            f"star-{n}",
            "the diagonal is worth more than a second arm of the star",
            paper=False,
        ),
        Claim(
            "unobserved", f"star-{n}", f"random-{n}", "a star is worth more than as many entries at random", paper=False
        ),
        Claim("new_light", f"{n}x{n}", f"loop-{n}", "all entries are worth more than a loop", paper=False),
    ]


STUDY = Study(
    name="structure",
    title="Structure of the matrix",
    question="Which links between photos matter?",
    paper="Photo sets need links: shared materials or shared lights. (A ranking of patterns is not taken over from the paper.)",
    varied="observed entries",
    measures=("unobserved", "observed", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=settings,
    claims=claims,
)
