"""Speed against error: both solvers, the operators and every reduction of the joint solver on the same sets.

Varied     cells, splittings and observations of the joint solver, its operator, the merging of observations that are
           alike, and the paper's solver.  Sets are of 2 × 2, full ones too: there are eleven settings, and the paper's
           solver with its own networks is slow.  The operator `reference` is left out: it takes hours.
           Mitsuba's joint optimisation is in the study of comparisons.
Measured   processor time of the stage `solve`, and what it predicts.
"""

from __future__ import annotations

from typing import Any

from studies.study import Scale, Setting, Study, full_matrix, own

VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "default": ("as it is", {}),
    "cells-150": ("150 cells", {"cells": 150}),
    "splittings-0": ("no splitting", {"splittings": 0}),
    "cells-150-splittings-0": ("150 cells, no splitting", {"cells": 150, "splittings": 0}),
    "observations-300": ("300 observations", {"observations": 300}),
    "observations-4000": ("4000 observations", {"observations": 4000}),
    "closed-form": ("closed form", {"operator": "closed_form"}),
    "merge-0": ("not merged", {"merge_degrees": 0.0}),
    "merge-4": ("merged to 4°", {"merge_degrees": 4.0}),
    "paper": ("paper's solver", {"solver": "paper", "operator": "network"}),
    "paper-network": ("all the paper's", {"solver": "paper", "operator": "paper_network"}),
}
QUICK = ("default", "closed-form", "merge-4", "paper")


def settings(scale: Scale) -> list[Setting]:
    """Return all of `VARIANTS`; of a quick study, those of `QUICK`."""
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
        own("entries", "default", "closed-form", "the network predicts better than the closed form"),
        own("entries", "default", "splittings-0", "splitting of cells predicts better"),
        own("entries", "default", "cells-150", "400 cells predict better than 150"),
        own("entries", "default", "observations-300", "1000 observations predict better than 300"),
        own("entries", "observations-4000", "default", "4000 observations predict better than 1000"),
        own("seconds", "default", "observations-4000", "1000 observations take less time than 4000"),
        own("entries", "merge-0", "default", "merging observations costs accuracy"),
        own("seconds", "default", "merge-0", "merging observations saves time"),
    ),
)
