"""Speed against error: every solver, operator and reduction of this project on the same sets.

Varied     the solver (this project's `bundle` and `few_lobes`, the paper's), its operator, most lobes a light, the merging of observations
           that are alike, and the sample.  Sets of 2 × 2, full ones too: there are eleven solvers, and the paper's with its own
           networks is slow.  The operator `reference` is left out: it takes hours.  Mitsuba's joint optimisation is in the study of comparisons.
Measured   processor time of the stage `solve`, and what it predicts.
"""

from __future__ import annotations

from typing import Any

from studies.core.study import Claim, Scale, Setting, Study, full_matrix

LOBES = {"solver": "few_lobes"}
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "default": ("as it is", {}),
    "lobes": ("lobes", LOBES),
    "closed-form": ("lobes, closed form", LOBES | {"operator": "closed_form"}),
    "lobes-16": ("16 lobes", LOBES | {"lobes": 16}),
    "lobes-32": ("32 lobes", LOBES | {"lobes": 32}),
    "merge-0": ("not merged", LOBES | {"merge_degrees": 0.0}),
    "merge-4": ("merged to 4°", LOBES | {"merge_degrees": 4.0}),
    "sample-700": ("sample 700", LOBES | {"sample": 700}),
    "sample-4000": ("sample 4000", LOBES | {"sample": 4000}),
    "paper": ("paper's solver", {"solver": "paper", "operator": "network"}),
    "paper-network": ("all the paper's", {"solver": "paper", "operator": "paper_network"}),
}
SEEN = full_matrix(2, 2)
QUICK = ("default", "closed-form", "merge-4", "paper")


def settings(scale: Scale) -> list[Setting]:
    """All of `VARIANTS`; of a quick study, those of `QUICK`."""
    names = QUICK if scale.name == "quick" else tuple(VARIANTS)
    return [scale.setting(name, VARIANTS[name][0], x, SEEN, solve=VARIANTS[name][1]) for x, name in enumerate(names)]


def claims(scale: Scale) -> list[Claim]:
    """This solver against the paper's, and what reductions cost."""
    own = [
        Claim("entries", "default", "paper", "this project's solver predicts better than the paper's", paper=False),
        Claim("seconds", "default", "paper", "it takes less time than the paper's", paper=False),
    ]
    if scale.name == "quick":
        return own
    return [
        *own,
        Claim(
            "seconds", "paper", "paper-network", "this project's operator makes the paper's solver faster", paper=False
        ),
        Claim("entries", "lobes", "closed-form", "the network predicts better than the closed form", paper=False),
        Claim("entries", "merge-0", "lobes", "merging observations costs accuracy", paper=False),
        Claim("seconds", "lobes", "merge-0", "merging observations saves time", paper=False),
        Claim("entries", "lobes", "lobes-16", "72 lobes predict better than 16", paper=False),
    ]


STUDY = Study(
    name="speed",
    title="Speed against error",
    question="Which solver, operator and reduction is worth its time?",
    paper="Nothing: the paper has one solver.",
    varied="solver, operator, reduction",
    measures=("seconds", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=settings,
    claims=claims,
    kind="speed",
)
