"""Structure: which links between photos matter?"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from studies.study import Entry, Scale, Setting, Study, full_matrix, own


def random(n: int, seed: int) -> list[Entry]:
    """Draw as many entries as a star has, again until each material and each light is among them."""
    rng, every = Random(seed), full_matrix(n, n)
    while True:
        drawn = sorted(rng.sample(every, 2 * n - 1))
        if len({m for m, _ in drawn}) == len({li for _, li in drawn}) == n:
            return drawn


PATTERNS: dict[str, Callable[[int, int], list[Entry]]] = {
    "full": lambda n, seed: full_matrix(n, n),
    "loop": lambda n, seed: sorted({entry for i in range(n) for entry in ((i, i), (i, (i + 1) % n))}),
    "star": lambda n, seed: sorted({entry for i in range(n) for entry in ((0, i), (i, 0))}),
    "link": lambda n, seed: sorted({entry for i in range(n) for entry in ((0, i), (i, i))}),
    "random": random,
    "diagonal": lambda n, seed: [(i, i) for i in range(n)],
}


def settings(scale: Scale) -> list[Setting]:
    """Return a setting for each pattern; the full matrix is the same case in other studies."""
    n = scale.largest
    return [
        Setting(f"{n}x{n}" if name == "full" else f"{name}-{n}", name, lambda seed, p=p: scale.case(seed, p(n, seed)))
        for name, p in PATTERNS.items()
    ]


STUDY = Study(
    name="structure",
    title="Structure of the matrix",
    question="Which links between photos matter?",
    paper="Photo sets need links: shared materials or shared lights. "
    "(A ranking of patterns is not taken over from the paper.)",
    varied="observed entries",
    measures=("unobserved", "observed", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=settings,
    claims=(
        own("unobserved", "link-5", "diagonal-5", "a linking material helps unconnected pairs"),
        own("unobserved", "loop-5", "diagonal-5", "a loop helps unconnected pairs"),
        own("unobserved", "link-5", "star-5", "the diagonal is worth more than a second arm of the star"),
        own("unobserved", "star-5", "random-5", "a star is worth more than as many entries at random"),
        own("new_light", "5x5", "loop-5", "all entries are worth more than a loop"),
    ),
)
