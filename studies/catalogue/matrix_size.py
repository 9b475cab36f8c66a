"""Matrix size: do more photos of more materials tell more of each?

Varied     the full matrix of n materials in n lights, n = 1 … 5.
Measured   material 0 in every light of its world, and every material of the world in light 0: these two all sizes share, and
           an answer is worth what it tells beyond the photos it was fitted to (the one entry of 1 × 1 is fitted all too easily).
"""

from __future__ import annotations

from studies.study import Claim, Scale, Study, own


def claims(scale: Scale) -> list[Claim]:
    """The largest against one photo, and against one less."""
    n, less = scale.largest, scale.largest - 1
    measures = {"first_material": "material 0", "first_light": "light 0"}
    return [
        *(Claim(m, f"{n}x{n}", "1x1", f"error falls from 1 × 1 to {n} × {n} ({what})") for m, what in measures.items()),
        *(own(m, f"{n}x{n}", f"{less}x{less}", f"it still falls from {less} × {less} ({of})") for m, of in measures.items()),
    ]  # fmt: skip


STUDY = Study(
    name="matrix-size",
    title="Matrix size",
    question="Do more photos of more materials tell more of each?",
    paper="The error falls as the full matrix grows from 1 × 1 to 5 × 5.",
    varied="materials × lights, all observed",
    measures=("first_material", "first_light", "entries", "diffuse", "specular", "roughness", "glossy"),
    settings=lambda scale: [scale.matrix(n, n) for n in range(1, scale.largest + 1)],
    claims=claims,
)
