"""Comparison: does a joint solve predict photos that were not taken better than methods that do less, or do the same by other means?

Varied     the method: the stage `solve`, Mitsuba's joint optimisation, an intrinsic decomposition, projective texturing, a grey ball.
           All see the same photos, of n materials in n lights on one convex body, its normals and the camera.
Measured   pictures from another side, in lights and of materials that no photo shows, each in three gauges; errors of the materials
           and lights that a method states; the processor's time.
"""

from __future__ import annotations

from studies.core.baselines.case import Comparison, Joint, Method
from studies.core.study import Claim, Scale, Setting, Study, full_matrix

LABELS: dict[Method, str] = {
    "ours": "ours",
    "mitsuba": "Mitsuba",
    "intrinsic": "intrinsic",
    "projective": "projective",
    "grey": "grey ball",
}
SIZES = {"full": 96, "quick": 32}
JOINT = {"full": Joint(pixels=48, steps=2000), "quick": Joint(pixels=16, steps=20)}
IN_THE_PAPER, OF_THE_PAPER = ("intrinsic", "projective"), ("novel_view", "novel_light")


def settings(scale: Scale) -> list[Setting]:
    """A method each."""
    return [_setting(scale, x, method) for x, method in enumerate(LABELS)]


def _setting(scale: Scale, x: int, method: Method) -> Setting:
    entries = tuple(full_matrix(scale.side, scale.side))
    size, joint = SIZES[scale.name], JOINT[scale.name]
    return Setting(method, LABELS[method], x, lambda seed: Comparison(seed, entries, method, size, joint, scale.solve))


def claims(scale: Scale) -> list[Claim]:
    """The joint solve against each of the others."""
    what = {
        "novel_view": "new views",
        "novel_light": "pictures in new light",
        "novel_material": "pictures of new materials",
    }
    return [
        Claim(
            measure,
            "ours",
            method,
            f"{words} are predicted better than by {_named(method)}",
            paper=method in IN_THE_PAPER and measure in OF_THE_PAPER,
        )
        for measure, words in what.items()
        for method in LABELS
        if method != "ours" and not (measure == "novel_material" and method == "projective")
    ]


def _named(method: Method) -> str:
    return {
        "mitsuba": "Mitsuba",
        "intrinsic": "the intrinsic decomposition",
        "projective": "projective texturing",
        "grey": "a grey ball",
    }[method]


STUDY = Study(
    name="comparison",
    title="Comparison",
    question="Does a joint solve predict photos that were not taken better than methods that do less, or do the same by other means?",
    paper="The joint solve is nearer to the truth than projective texturing and than an intrinsic decomposition (SIRFS), averaged over photos.",
    varied="method",
    measures=(
        "novel_view", "novel_light", "novel_material", "processor", "novel_view_balanced", "novel_light_balanced", "novel_material_balanced",
        "diffuse", "specular", "roughness", "mirror", "glossy", "lambertian",
    ),
    settings=settings,
    claims=claims,
    kind="baselines",
)  # fmt: skip
