"""Speed against error: every solver, operator and reduction of this project on the same sets.

Varied     the solver (this project's `bundle` and `few_lobes`, the paper's), its operator, most lobes a light, the merging of observations
           that are alike, and the sample.  Sets of 2 × 2, full ones too: there are eleven solvers, and the paper's with its own
           networks is slow.  The operator `reference` is left out: it takes hours.  Mitsuba's joint optimisation is in the study of comparisons.
Measured   processor time of the stage `solve`, and what it predicts.
"""

from __future__ import annotations

from typing import Any

from studies.study import Scale, Setting, Study, full_matrix, own

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
QUICK = ("default", "closed-form", "merge-4", "paper")


def settings(scale: Scale) -> list[Setting]:
    """All of `VARIANTS`; of a quick study, those of `QUICK`."""
    variants = {name: VARIANTS[name] for name in (QUICK if scale.quick else VARIANTS)}
    return [scale.setting(name, label, full_matrix(2, 2), solve=how) for name, (label, how) in variants.items()]


STUDY = Study(
    name="speed",
    title="Speed against error",
    question="Which solver, operator and reduction is worth its time?",
    paper="Nothing: the paper has one solver.",
    varied="solver, operator, reduction",
    measures=("seconds", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=settings,
    claims=(
        own("entries", "default", "paper", "this project's solver predicts better than the paper's"),
        own("seconds", "default", "paper", "it takes less time than the paper's"),
        own("seconds", "paper", "paper-network", "this project's operator makes the paper's solver faster"),
        own("entries", "lobes", "closed-form", "the network predicts better than the closed form"),
        own("entries", "merge-0", "lobes", "merging observations costs accuracy"),
        own("seconds", "lobes", "merge-0", "merging observations saves time"),
        own("entries", "lobes", "lobes-16", "72 lobes predict better than 16"),
    ),
)
