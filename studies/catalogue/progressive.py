"""Progressive: does each further photo of the same materials improve re-rendering, material and light?"""

from __future__ import annotations

from studies.study import Claim, Scale, Setting, Study, full_matrix, own


def settings(scale: Scale) -> list[Setting]:
    """Return settings of more and more photos, then of the same from the solution before."""
    n, entries = scale.largest, [full_matrix(scale.side, k) for k in range(scale.largest + 1)]
    cold = [scale.of_objects(f"photos-{k}", str(k), entries[k]) for k in range(1, n + 1)]
    return cold + [scale.of_objects(f"photos-{k}-warm", f"{k} warm", entries[k], warm=True) for k in range(2, n + 1)]


STUDY = Study(
    name="progressive",
    title="Progressive",
    question="Does each further photo of the same materials improve re-rendering, material and light?",
    paper="Each further photo improves re-rendering, the materials and the lights.",
    varied="photos of the same materials",
    measures=("new_light", "first_light", "seconds", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=(
        Claim("new_light", "photos-5", "photos-1", "5 photos are better than one (re-rendering)"),
        Claim("diffuse", "photos-5", "photos-1", "5 photos are better than one (k_d)"),
        Claim("roughness", "photos-5", "photos-1", "5 photos are better than one (roughness)"),
        Claim("first_light", "photos-5", "photos-1", "5 photos are better than one (light 0)"),
        own("new_light", "photos-5", "photos-4", "the last of 5 photos still improves re-rendering"),
        own("seconds", "photos-5-warm", "photos-5", "a warm start takes less time than a start from nothing"),
        own("new_light", "photos-5-warm", "photos-5", "a warm start is better than one from nothing"),
        own("new_light", "photos-5", "photos-5-warm", "a start from nothing is better than a warm one"),
    ),
    lights=1,
)
