"""Matrix size: do more photos of more materials tell more of each?"""

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
