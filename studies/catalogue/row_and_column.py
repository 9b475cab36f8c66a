"""Row and column: is one material in many lights worth as much as many materials in one light?

Varied     1 × n (one material, n lights), n × 1 (n materials, one light), and n × n and 1 × 1 to set them against.
Measured   their own entries, as in the paper; and, as for the size of the matrix, material 0 and light 0, which all four share.
"""

from __future__ import annotations

from studies.study import Claim, Scale, Study, own


def claims(scale: Scale) -> list[Claim]:
    """The row against the column, and both against one entry."""
    n = scale.largest
    row, column = f"1x{n}", f"{n}x1"
    return [
        Claim("entries", row, column, f"1 × {n} predicts its entries better than {n} × 1"),
        own("first_material", row, column, f"1 × {n} tells more of material 0 than {n} × 1"),
        own("first_material", row, "1x1", "more lights tell more of material 0"),
        own("first_light", column, "1x1", "more materials tell more of light 0"),
    ]


STUDY = Study(
    name="row-and-column",
    title="Row and column",
    question="Is one material in many lights worth as much as many materials in one light?",
    paper="1 × 5 does well, 5 × 1 slightly worse.",
    varied="materials × lights, all observed",
    measures=("entries", "first_material", "first_light", "diffuse", "specular", "roughness", "glossy"),
    settings=lambda scale: [scale.matrix(m, n) for m in (1, scale.largest) for n in (1, scale.largest)],
    claims=claims,
)
