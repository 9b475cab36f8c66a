"""The paper's sets: which entries of its photo sets' matrices can be predicted?

How its Docksta photos share materials is read from its description (seven materials, six photos, one linking chair),
not from the photos.
"""

from __future__ import annotations

from studies.study import Claim, Entry, Scale, Setting, Study, full_matrix, own


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


def settings(scale: Scale) -> list[Setting]:
    """Return a setting for each set."""
    sets = patterns(scale).items()
    return [scale.of_objects(f"set-{name}", name.replace("-unlinked", " without chair"), of) for name, of in sets]


DOCKSTA, UNLINKED = "set-docksta", "set-docksta-unlinked"
BETTER = "are predicted better than by a guess of mean colours"
STUDY = Study(
    name="paper-sets",
    title="Sets of the paper",
    question="Which entries of the matrices of the paper's photo sets can be predicted?",
    paper="Sets as sparse as Docksta (one linking chair) and as small as LAPD (two materials) are factored, "
    "as are full ones.",
    varied="observation pattern of a set",
    measures=("unobserved", "observed", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=settings,
    claims=(
        Claim(
            "unobserved", DOCKSTA, ("guess", DOCKSTA), f"entries of Docksta's pattern that were not observed {BETTER}"
        ),
        Claim("entries", "set-lapd", ("guess", "set-lapd"), f"entries of LAPD's pattern {BETTER}"),
        Claim("entries", "set-photos", ("guess", "set-photos"), f"entries of all photos {BETTER}"),
        Claim("unobserved", DOCKSTA, UNLINKED, "the linking chair helps to predict what was not observed"),
        own("observed", DOCKSTA, UNLINKED, "the linking chair helps with what was observed"),
        own("entries", "set-photos", DOCKSTA, "the full matrix is predicted better than the linked one"),
    ),
    lights=1,
)
