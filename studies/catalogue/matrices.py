"""Size and structure of the matrix of materials × lights.

How the paper's Docksta photos share materials is read from its description (seven materials, six photos, one linking
chair), not from the photos.
"""

from collections.abc import Callable
from random import Random

from studies.study import Claim, Entry, Scale, Setting, Study, full_matrix, project_claim

# ── matrix size ───────────────────────────────────────────────────────────────────────────────────────────────────────

MATRIX_SIZE = Study(
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
        project_claim("first_material", "5x5", "4x4", "it still falls from 4 × 4 (material 0)"),
        project_claim("first_light", "5x5", "4x4", "it still falls from 4 × 4 (light 0)"),
    ),
)


# ── row and column ────────────────────────────────────────────────────────────────────────────────────────────────────

ROW_AND_COLUMN = Study(
    name="row-and-column",
    title="Row and column",
    question="Is one material in many lights worth as much as many materials in one light?",
    paper="1 × 5 does well, 5 × 1 slightly worse.",
    varied="materials × lights, all observed",
    measures=("entries", "first_material", "first_light", "diffuse", "specular", "roughness", "glossy"),
    settings=lambda scale: [scale.matrix(m, n) for m in (1, scale.largest) for n in (1, scale.largest)],
    claims=(
        Claim("entries", "1x5", "5x1", "1 × 5 predicts its entries better than 5 × 1"),
        project_claim("first_material", "1x5", "5x1", "1 × 5 tells more of material 0 than 5 × 1"),
        project_claim("first_material", "1x5", "1x1", "more lights tell more of material 0"),
        project_claim("first_light", "5x1", "1x1", "more materials tell more of light 0"),
    ),
)


# ── structure ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def random_entries(n: int, seed: int) -> list[Entry]:
    """Draw as many entries as a star has, again until each material and each light is among them."""
    rng = Random(seed)
    every = full_matrix(n, n)
    while True:
        entries = sorted(rng.sample(every, 2 * n - 1))
        if len({m for m, _ in entries}) == len({li for _, li in entries}) == n:
            return entries


PATTERNS: dict[str, Callable[[int, int], list[Entry]]] = {
    "full": lambda n, seed: full_matrix(n, n),
    "loop": lambda n, seed: sorted({entry for i in range(n) for entry in ((i, i), (i, (i + 1) % n))}),
    "star": lambda n, seed: sorted({entry for i in range(n) for entry in ((0, i), (i, 0))}),
    "link": lambda n, seed: sorted({entry for i in range(n) for entry in ((0, i), (i, i))}),
    "random": random_entries,
    "diagonal": lambda n, seed: [(i, i) for i in range(n)],
}


def structure_settings(scale: Scale) -> list[Setting]:
    """Return a setting for each pattern; the full matrix is the same case in other studies."""
    n = scale.largest
    return [
        Setting(f"{n}x{n}" if name == "full" else f"{name}-{n}", name, lambda seed, p=p: scale.case(seed, p(n, seed)))
        for name, p in PATTERNS.items()
    ]


STRUCTURE = Study(
    name="structure",
    title="Structure of the matrix",
    question="Which links between photos matter?",
    paper="Photo sets need links: shared materials or shared lights. "
    "(A ranking of patterns is not taken over from the paper.)",
    varied="observed entries",
    measures=("unobserved", "observed", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=structure_settings,
    claims=(
        project_claim("unobserved", "link-5", "diagonal-5", "a linking material helps unconnected pairs"),
        project_claim("unobserved", "loop-5", "diagonal-5", "a loop helps unconnected pairs"),
        project_claim("unobserved", "link-5", "star-5", "the diagonal is worth more than a second arm of the star"),
        project_claim("unobserved", "star-5", "random-5", "a star is worth more than as many entries at random"),
        project_claim("new_light", "5x5", "loop-5", "all entries are worth more than a loop"),
    ),
)


# ── paper sets ────────────────────────────────────────────────────────────────────────────────────────────────────────


def patterns(scale: Scale) -> dict[str, list[Entry]]:
    """Return the entries of each set, by its name.

    >>> from studies.study import QUICK
    >>> patterns(QUICK)["docksta"]
    [(0, 0), (0, 1), (0, 2), (1, 0), (2, 1), (3, 2)]
    """
    photos, fewer = (3, 2) if scale.quick else (6, 4)
    unlinked = [(p + 1, p) for p in range(photos)]
    return {
        "docksta": sorted([(0, p) for p in range(photos)] + unlinked),
        "docksta-unlinked": unlinked,
        "lapd": full_matrix(2, fewer),
        "photos": full_matrix(scale.largest, scale.largest),
    }


def paper_sets_settings(scale: Scale) -> list[Setting]:
    """Return a setting for each set."""
    sets = patterns(scale).items()
    return [
        scale.object_setting(f"set-{name}", name.replace("-unlinked", " without chair"), entries)
        for name, entries in sets
    ]


DOCKSTA = "set-docksta"
UNLINKED = "set-docksta-unlinked"
BETTER = "are predicted better than by a guess of mean colours"
PAPER_SETS = Study(
    name="paper-sets",
    title="Sets of the paper",
    question="Which entries of the matrices of the paper's photo sets can be predicted?",
    paper="Sets as sparse as Docksta (one linking chair) and as small as LAPD (two materials) are factored, "
    "as are full ones.",
    varied="observation pattern of a set",
    measures=("unobserved", "observed", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=paper_sets_settings,
    claims=(
        Claim(
            "unobserved", DOCKSTA, ("guess", DOCKSTA), f"entries of Docksta's pattern that were not observed {BETTER}"
        ),
        Claim("entries", "set-lapd", ("guess", "set-lapd"), f"entries of LAPD's pattern {BETTER}"),
        Claim("entries", "set-photos", ("guess", "set-photos"), f"entries of all photos {BETTER}"),
        Claim("unobserved", DOCKSTA, UNLINKED, "the linking chair helps to predict what was not observed"),
        project_claim("observed", DOCKSTA, UNLINKED, "the linking chair helps with what was observed"),
        project_claim("entries", "set-photos", DOCKSTA, "the full matrix is predicted better than the linked one"),
    ),
    lights=1,
)
