"""Progressive: does each further photo of the same materials improve re-rendering, material and light?

Varied     photos 1 … n of the same three materials (quick: two), each in a light of its own, light 0 in all; from nothing, and from the
           solution of all photos but the last, which is the stage's parameter `start`.
Measured   the materials in every light of the world, all materials of the world in light 0: both are the same question of however
           many photos; errors of the materials' numbers; processor seconds of the solve, of a warm one those of the last photo alone.
"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, full_matrix, own


def settings(scale: Scale) -> list[Setting]:
    """Photos one by one; then the same from the solution before."""
    n = scale.largest
    cold = [scale.of_objects(f"photos-{k}", str(k), full_matrix(scale.side, k)) for k in range(1, n + 1)]
    return cold + [
        scale.of_objects(f"photos-{k}-warm", f"{k} warm", full_matrix(scale.side, k), start="earlier")
        for k in range(2, n + 1)
    ]


def claims(scale: Scale) -> list[Claim]:
    """All photos against one and against one less; warm against from nothing."""
    n, what = scale.largest, {"new_light": "re-rendering", "diffuse": "k_d", "roughness": "roughness", "first_light": "light 0"}  # fmt: skip
    cold, warm = f"photos-{n}", f"photos-{n}-warm"
    return [
        *(Claim(m, cold, "photos-1", f"{n} photos are better than one ({words})") for m, words in what.items()),
        own("new_light", cold, f"photos-{n - 1}", f"the last of {n} photos still improves re-rendering"),
        own("seconds", warm, cold, "a warm start takes less time than a start from nothing"),
        own("new_light", warm, cold, "a warm start is better than one from nothing"),
        own("new_light", cold, warm, "a start from nothing is better than a warm one"),
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
    lights=1,
    pictures="studies.steps.score.spheres_by_setting",
)
