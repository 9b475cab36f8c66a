"""Row and column: is one material in many lights worth as much as many materials in one light?

Varied     1 × n (one material, n lights), n × 1 (n materials, one light), and n × n and 1 × 1 to set them against.
Measured   their own entries, as in the paper; and, as for the size of the matrix, material 0 and light 0, which all four share.
"""

from __future__ import annotations

from studies.core.study import Claim, Scale, Setting, Study


def settings(scale: Scale) -> list[Setting]:
    """One entry, a row, a column, all."""
    n = scale.largest
    return [scale.matrix(x, *shape) for x, shape in enumerate([(1, 1), (1, n), (n, 1), (n, n)])]


def claims(scale: Scale) -> list[Claim]:
    """The row against the column, and both against one entry."""
    n = scale.largest
    row, column = f"1x{n}", f"{n}x1"
    return [
        Claim("entries", row, column, f"1 × {n} predicts its entries better than {n} × 1"),
        Claim("first_material", row, column, f"1 × {n} tells more of material 0 than {n} × 1", paper=False),
        Claim("first_material", row, "1x1", "more lights tell more of material 0", paper=False),
        Claim("first_light", column, "1x1", "more materials tell more of light 0", paper=False),
    ]


STUDY = Study(
    name="row-and-column",
    title="Row and column",
    question="Is one material in many lights worth as much as many materials in one light?",
    paper="1 × 5 does well, 5 × 1 slightly worse.",
    varied="materials × lights, all observed",
    measures=("entries", "first_material", "first_light", "diffuse", "specular", "roughness", "glossy"),
    settings=settings,
    claims=claims,
)
