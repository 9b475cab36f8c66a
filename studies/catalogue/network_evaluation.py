"""Network evaluation: how far are the operators from exact reflection, by roughness?

Varied     the operator (this project's network, its closed form, the paper's networks) and the band of roughness, .1 … 1.
Measured   errors of single evaluations, of a rendered sphere, and the time; seeds are samples and lights.
"""

from __future__ import annotations

from studies.core.band import Band
from studies.core.study import Claim, Scale, Setting, Study

OPERATORS = {"network": "network", "closed_form": "closed form", "paper_network": "paper's"}
BANDS = {"full": (0.1, 0.14, 0.2, 0.3, 0.45, 0.65, 1.0), "quick": (0.1, 0.3, 1.0)}
SAMPLES = {"full": 4096, "quick": 256}


def settings(scale: Scale) -> list[Setting]:
    """Each operator, band by band."""
    edges = BANDS[scale.name]
    pairs = [(operator, k) for operator in OPERATORS for k in range(len(edges) - 1)]
    return [_setting(scale, x, operator, k) for x, (operator, k) in enumerate(pairs)]


def _setting(scale: Scale, x: int, operator: str, k: int) -> Setting:
    low, high = BANDS[scale.name][k : k + 2]
    label = f"{OPERATORS[operator]}, {low:g}–{high:g}"
    return Setting(_name(operator, k), label, x, lambda seed: Band(seed, operator, low, high, SAMPLES[scale.name]))


def _name(operator: str, k: int) -> str:
    return f"{operator.replace('_', '-')}-{k}"


def claims(scale: Scale) -> list[Claim]:
    """The network against the others, in the smoothest and in the roughest band."""
    last = len(BANDS[scale.name]) - 2
    ends = ((0, "smoothest"), (last, "roughest"))
    return [
        Claim(
            measure,
            _name("network", k),
            _name(other, k),
            f"the network is nearer than {words} for the {band} ({of})",
            paper=False,
        )
        for k, band in ends
        for other, words in (("closed_form", "the closed form"), ("paper_network", "the paper's networks"))
        for measure, of in (("error_median", "median error"), ("rendering", "sphere"))
    ]


STUDY = Study(
    name="network-evaluation",
    title="Network evaluation",
    question="How far are the operators from exact reflection, by roughness?",
    paper="The network's renderings beside true ones, by roughness. (No number is taken over from the paper.)",
    varied="operator and roughness",
    measures=("error_median", "error_p95", "rendering", "microseconds", "error_worst"),
    settings=settings,
    claims=claims,
    kind="operator",
)
