"""The paper's sets: which entries of its photo sets' matrices can be predicted?

Varied     the observation pattern, of this project's own bodies, materials and lights:
           docksta   seven materials in six photos; each photo shows a material of its own, and one, of a chair, is in all
           lapd      two materials of one object in four photos, all observed
           photos    all of n materials in all of n photos, n = 5
           (quick: docksta of four materials in three photos, lapd in two photos, photos 3 × 3)
Measured   entries that were observed and those that were not.  The paper's photographs cannot be had.  How its Docksta photos share
           materials is read from its description (seven materials, six photos, one linking chair), not from the photos.
"""

from __future__ import annotations

from studies.core.entries import Entry
from studies.core.objects.setting import setting
from studies.core.study import Claim, Guess, Scale, Setting, Study, full_matrix


def docksta(photos: int) -> list[Entry]:
    """Material 0 in all photos, and in each one more.

    >>> docksta(2)
    [(0, 0), (0, 1), (1, 0), (2, 1)]
    """
    return sorted([(0, p) for p in range(photos)] + [(p + 1, p) for p in range(photos)])


def unlinked(photos: int) -> list[Entry]:
    """The same without the linking material.

    >>> unlinked(2)
    [(1, 0), (2, 1)]
    """
    return [(p + 1, p) for p in range(photos)]


def patterns(scale: Scale) -> dict[str, list[Entry]]:
    """Entries by the names of the sets."""
    full = scale.name == "full"
    photos = 6 if full else 3
    return {
        "docksta": docksta(photos),
        "docksta-unlinked": unlinked(photos),
        "lapd": full_matrix(2, 4 if full else 2),
        "photos": full_matrix(scale.largest, scale.largest),
    }


def settings(scale: Scale) -> list[Setting]:
    """A set each."""
    return [
        setting(scale, f"set-{name}", name.replace("-unlinked", " without chair"), x, entries)
        for x, (name, entries) in enumerate(patterns(scale).items())
    ]


def claims(scale: Scale) -> list[Claim]:
    """Each set is predicted better than by a guess that knows mean colours; what links the photos is worth something, and a full
    matrix more than a sparse one."""
    sets = (("docksta", "unobserved", "entries of Docksta's pattern that were not observed"), ("lapd", "entries", "entries of LAPD's pattern"),
            ("photos", "entries", "entries of all photos"))  # fmt: skip
    return [
        *(
            Claim(
                measure,
                f"set-{name}",
                Guess(f"set-{name}"),
                f"{words} are predicted better than by a guess of mean colours",
            )
            for name, measure, words in sets
        ),
        Claim(
            "unobserved",
            "set-docksta",
            "set-docksta-unlinked",
            "the linking chair helps to predict what was not observed",
        ),
        Claim(
            "observed",
            "set-docksta",
            "set-docksta-unlinked",
            "the linking chair helps with what was observed",
            paper=False,
        ),
        Claim(
            "entries",
            "set-photos",
            "set-docksta",
            "the full matrix is predicted better than the linked one",
            paper=False,
        ),
    ]


STUDY = Study(
    name="paper-sets",
    title="Sets of the paper",
    question="Which entries of the matrices of the paper's photo sets can be predicted?",
    paper="Sets as sparse as Docksta (one linking chair) and as small as LAPD (two materials) are factored, as are full ones.",
    varied="observation pattern of a set",
    measures=("unobserved", "observed", "entries", "new_light", "diffuse", "specular", "roughness"),
    settings=settings,
    claims=claims,
    kind="objects",
)
