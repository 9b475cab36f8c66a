"""Matrix size: do more photos of more materials tell more of each?

Varied     the full matrix of n materials in n lights, n = 1 … 5.
Measured   material 0 in every light of its world, and every material of the world in light 0: these two all sizes share, and
           an answer is worth what it tells beyond the photos it was fitted to (the one entry of 1 × 1 is fitted all too easily).
"""

from __future__ import annotations

from studies.study import Claim, Study, own

STUDY = Study(
    name="matrix-size",
    title="Matrix size",
    question="Do more photos of more materials tell more of each?",
    paper="The error falls as the full matrix grows from 1 × 1 to 5 × 5.",
    varied="materials × lights, all observed",
    measures=("first_material", "first_light", "entries", "diffuse", "specular", "roughness", "glossy"),
    settings=lambda scale: [scale.matrix(n, n) for n in range(1, scale.largest + 1)],
    claims=(
        Claim("first_material", "5x5", "1x1", "error falls from 1 × 1 to 5 × 5 (material 0)"),
        Claim("first_light", "5x5", "1x1", "error falls from 1 × 1 to 5 × 5 (light 0)"),
        own("first_material", "5x5", "4x4", "it still falls from 4 × 4 (material 0)"),
        own("first_light", "5x5", "4x4", "it still falls from 4 × 4 (light 0)"),
    ),
)
