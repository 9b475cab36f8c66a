"""Progressive: does each further photo of the same materials improve re-rendering, material and light?

Varied     photos 1 … n of the same three materials (quick: two), each in a light of its own, light 0 in all; from nothing, and from the
           solution of all photos but the last, which is the stage's parameter `start`.
Measured   the materials in every light of the world, all materials of the world in light 0: both are the same question of however
           many photos; errors of the materials' numbers; processor seconds of the solve, of a warm one those of the last photo alone.
"""

from __future__ import annotations

from studies.core.objects.setting import setting
from studies.core.study import Claim, Scale, Setting, Study, full_matrix


def settings(scale: Scale) -> list[Setting]:
    """Photos one by one; then the same from the solution before."""
    cold = [_setting(scale, n, n, "nothing") for n in range(1, scale.largest + 1)]
    return cold + [_setting(scale, scale.largest + n, n, "earlier") for n in range(2, scale.largest + 1)]


def _setting(scale: Scale, x: int, n: int, start: str) -> Setting:
    name, label = (f"photos-{n}-warm", f"{n} warm") if start == "earlier" else (f"photos-{n}", str(n))
    return setting(scale, name, label, x, full_matrix(scale.side, n), start=start)


def claims(scale: Scale) -> list[Claim]:
    """All photos against one and against one less; warm against from nothing."""
    n = scale.largest
    measures = (
        ("new_light", "re-rendering"),
        ("diffuse", "k_d"),
        ("roughness", "roughness"),
        ("first_light", "light 0"),
    )
    return [
        *(Claim(m, f"photos-{n}", "photos-1", f"{n} photos are better than one ({what})") for m, what in measures),
        Claim(
            "new_light",
            f"photos-{n}",
            f"photos-{n - 1}",
            f"the last of {n} photos still improves re-rendering",
            paper=False,
        ),
        Claim(
            "seconds",
            f"photos-{n}-warm",
            f"photos-{n}",
            "a warm start takes less time than a start from nothing",
            paper=False,
        ),
        Claim(
            "new_light", f"photos-{n}-warm", f"photos-{n}", "a warm start is better than one from nothing", paper=False
        ),
        Claim(
            "new_light",
            f"photos-{n}",
            f"photos-{n}-warm",
            "a start from nothing is better than a warm one",
            paper=False,
        ),
    ]


STUDY = Study(
    name="progressive",
    title="Progressive",
    question="Does each further photo of the same materials improve re-rendering, material and light?",
    paper="Each further photo improves re-rendering, the materials and the lights.",
    varied="photos of the same materials",
    measures=("new_light", "first_light", "seconds", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=claims,
    kind="objects",
)
