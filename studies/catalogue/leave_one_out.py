"""Leave one out: can a chair be predicted in a photo from everything else?

Data       data/eames, six photos of chairs, rendered and made hard as photographs are: poses are searched, meshes are not exact
Left out   one entry of the matrix, as in the paper: the pixels of one chair's shell in one photo.  Its material is then known from
           the other photos alone, and the photo's light and exposure from what is left of the photo: the wooden legs, and the second
           chair where there is one.  A photo of which nothing is left would tell nothing of its light
Varied     left out; observed (the same pixels took part in the solve: what the model can fit at best); flat (no model of light: the
           shell's mean colour in the other photos, in the brightness and tint that the legs have here)
Spread     the six photos (of a photo with two chairs, the mean of both): one set, so nothing is said of other sets

(quick: photos kitchen and hall alone, few lobes.)
"""

from __future__ import annotations

from studies.core.left_out.case import CHAIRS, LeftOutCase, Prediction
from studies.core.study import Claim, Scale, Setting, Study

PHOTOS = {"full": tuple(CHAIRS), "quick": ("kitchen", "hall")}
PREDICTIONS: tuple[Prediction, ...] = ("left out", "observed", "flat")


def settings(scale: Scale) -> list[Setting]:
    """Ways to predict; what stands in a seed's place is the number of a photo."""
    return [_setting(scale, x, prediction) for x, prediction in enumerate(PREDICTIONS)]


def _setting(scale: Scale, x: int, prediction: Prediction) -> Setting:
    photos = PHOTOS[scale.name]
    case = lambda photo: LeftOutCase(photos[photo], photos, prediction, scale.solve)  # noqa: E731
    return Setting(f"chair-{prediction.replace(' ', '-')}", prediction, x, case)


def spread(scale: Scale) -> tuple[int, ...]:
    """Numbers of the photos whose chairs are predicted."""
    return tuple(range(len(PHOTOS["full"]))) if scale.name == "full" else (0,)


def claims(scale: Scale) -> list[Claim]:
    """Better than without light; worse than with the chair."""
    return [
        Claim(
            "chair",
            "chair-left-out",
            "chair-flat",
            "a chair that was left out is predicted better than by a flat colour",
        ),
        Claim("chair_scaled", "chair-left-out", "chair-flat", "the same with brightness and tint given", paper=False),
        Claim(
            "chair",
            "chair-observed",
            "chair-left-out",
            "a chair that was observed is shown better than one that was left out",
            paper=False,
        ),
    ]


STUDY = Study(
    name="leave-one-out",
    title="Leave one out",
    question="Can a chair be predicted in a photo from everything else?",
    paper="A chair of the eames photos that took no part in the solve can be predicted. (Its photos and numbers cannot be had.)",
    varied="where the chair is predicted from",
    measures=("chair", "chair_scaled"),
    settings=settings,
    claims=claims,
    kind="left_out",
    spread=spread,
    over="photos",
)
