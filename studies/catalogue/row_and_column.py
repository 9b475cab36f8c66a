"""Row and column: is one material in many lights worth as much as many materials in one light?"""

from __future__ import annotations

from studies.study import Claim, Study, own

STUDY = Study(
    name="row-and-column",
    title="Row and column",
    question="Is one material in many lights worth as much as many materials in one light?",
    paper="1 × 5 does well, 5 × 1 slightly worse.",
    varied="materials × lights, all observed",
    measures=("entries", "first_material", "first_light", "diffuse", "specular", "roughness", "glossy"),
    settings=lambda scale: [scale.matrix(m, n) for m in (1, scale.largest) for n in (1, scale.largest)],
    claims=(
        Claim("entries", "1x5", "5x1", "1 × 5 predicts its entries better than 5 × 1"),
        own("first_material", "1x5", "5x1", "1 × 5 tells more of material 0 than 5 × 1"),
        own("first_material", "1x5", "1x1", "more lights tell more of material 0"),
        own("first_light", "5x1", "1x1", "more materials tell more of light 0"),
    ),
)
