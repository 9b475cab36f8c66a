"""Verdict on whether a result can be trusted, without any truth.

The expected mean square error of balls of the recovered materials in the recovered lights, shown as for the relit set
score (`factorlib.evaluate.relighting`), is

    e² = FLOOR + MATERIALS m² + CLIPPED c² + UNEXPLAINED u^¾ + CONTOUR d²         (1)

m²  squared change of a ball per standard error of each reflectance and of roughness, summed over these, mean over balls
c   share of values that are clipped, mean over photos
u   share of the shading that is not explained (`factorlib.inference.model.misfit`)
d   distance between the outlines of meshes and masks (`contour_error` of poses.json), mean over objects

and −10 log₁₀ e² is the expected score in dB.  Where no shading is explained, u = 1, a result is worth a flat colour,
which gives UNEXPLAINED.  The other weights were fitted to 26 made sets of very different quality.  `GOOD` and `POOR`
hold on these: no set that scores less than 18 dB, as a flat disc of the mean colour does, is called good, and no set
that scores 24 dB or more is called untrustworthy, also where a set is left out of the fit (docs/verdict.md,
`python -m studies.measured.verdict`).
"""

from collections.abc import Iterator, Mapping

import msgspec
import numpy as np

from factorlib.evaluate.ball import OctahedralLight
from factorlib.evaluate.picture_errors import tone_map
from factorlib.evaluate.predicted_views import describe_views
from factorlib.evaluate.relighting import MEAN_SHOWN, Appearances
from factorlib.inference.answer.identifiability import helpful_light
from factorlib.inference.model.materials import ROUGHNESS
from factorlib.results.materials import Misfit, Reflectance, SolvedMaterial
from factorlib.results.metrics import Trust, Verdict

# weights of (1)
FLOOR = 1e-5
MATERIALS = 0.217
CLIPPED = 0.125
UNEXPLAINED = 0.0141  # e² of 18.5 dB, the score of a flat colour
CONTOUR = 230.0
DEVIATION = 4.0  # deviation of the scores from the expected one, dB
GOOD = 24.0  # least expected score of a good result, dB
POOR = 19.0  # least expected score of a usable result, dB
DISAGREES = 3.0  # residuals above which shapes and photos disagree, in units of their noise
# Residuals of photos that had no part in the surface above which photos disagree about it, in units of their noise.
SURFACE_DISAGREES = 2.0
FITTING = 0.95  # silhouette overlap (IoU) above which an overlay shows no fault
MUCH = 0.1  # unexplained share from which an input is wrong and not only inaccurate
LEAST_SHARE = 0.2  # least share of e² for a term to be a reason


def ball_changes(materials: Mapping[str, SolvedMaterial], lights: Mapping[str, OctahedralLight]) -> dict[str, float]:
    """Return the mean square change of each material's ball by its standard errors, m² of (1), mean over lights.

    Both arguments are in one gauge, and the materials have standard errors.
    """
    lit = [Appearances(light) for light in lights.values()]
    return {name: float(np.mean([_change(solved, balls) for balls in lit])) for name, solved in materials.items()}


def _change(solved: SolvedMaterial, lit: Appearances) -> float:
    """Return the mean square change of a ball in a light, summed over diffuse, specular and roughness."""
    ball = lit.ball(solved.reflectance)
    exposure = MEAN_SHOWN / max(float(ball.mean()), 1e-30)
    display = tone_map(ball, exposure)
    squares = [np.mean((tone_map(lit.ball(other), exposure) - display) ** 2) for other in _others(solved)]
    return float(np.sum(squares)) / 2


def _others(solved: SolvedMaterial) -> Iterator[Reflectance]:
    """Yield the reflectance with each of its parts one standard error lower and higher."""
    estimate = solved.reflectance
    errors = solved.stderr
    for sign in (-1, 1):
        for part in ("diffuse", "specular"):
            moved = np.clip(np.array(getattr(estimate, part)) + sign * np.array(getattr(errors, part)), 0, 1)
            yield msgspec.structs.replace(estimate, **{part: tuple(moved.tolist())})
        roughness = float(np.clip(estimate.roughness + sign * errors.roughness, *ROUGHNESS))
        yield msgspec.structs.replace(estimate, roughness=roughness)


class VerdictInputs(msgspec.Struct, frozen=True):
    """Measured quantities from which (1) predicts the score.

    Attributes:
        materials: m² of each material that a photo shows (`ball_changes`)
        unexplained: u, share of the shading of all photos that is not explained
        photos: unexplained share and clipped share of each photo
        contours: d, contour error of each object with a compared outline, by photo and object
        deviation: deviation of the residuals in units of their noise, which scales the standard errors of materials
        overlaps: silhouette overlap (IoU) of each object, by photo and object
        surface: residual of photos that had no part in the surface, in units of their noise; None if it is not known
        lit_hard: materials that a photo shows in light with a small bright source
    """

    materials: dict[str, float]
    unexplained: float
    photos: dict[str, Misfit]
    contours: dict[str, dict[str, float]]
    deviation: float = 1.0
    overlaps: dict[str, dict[str, float]] = {}
    surface: float | None = None
    lit_hard: frozenset[str] = frozenset()

    def terms(self) -> dict[str, float]:
        """Return the four measured terms of (1) by name, all but FLOOR."""
        contours = [error for errors in self.contours.values() for error in errors.values()]
        return {
            "materials": MATERIALS * float(np.mean(list(self.materials.values()))),
            "clipped": CLIPPED * float(np.mean([photo.clipped for photo in self.photos.values()])) ** 2,
            "unexplained": UNEXPLAINED * float(self.unexplained**0.75),
            "contour": CONTOUR * float(np.mean(contours or [0.0])) ** 2,
        }


def verdict(inputs: VerdictInputs) -> Verdict:
    """Return the expected score of (1), the reasons that limit it, and the next step."""
    terms = inputs.terms()
    whole = FLOOR + sum(terms.values())
    expected = round(float(-10 * np.log10(whole)), 3)
    trust: Trust = "good" if expected >= GOOD else "usable with care" if expected >= POOR else "do not trust"
    ranked = sorted(terms, key=terms.__getitem__, reverse=True)
    limiting = [name for name in ranked if terms[name] >= LEAST_SHARE * whole] or ranked[:1]
    explained = [EXPLANATIONS[name](inputs) for name in limiting]
    reasons = [why for why, _ in explained]
    if inputs.surface is not None and inputs.surface > SURFACE_DISAGREES:
        reasons.append(
            f"photos that disagree about the surface: it misses those that had no part in it by {inputs.surface:.1f} "
            "times their noise"
        )
    rounded = {name: float(f"{term:.6g}") for name, term in terms.items()}
    return Verdict(trust, expected, DEVIATION, reasons, explained[0][1], rounded)


def verdict_text(verdict: Verdict, views: Mapping[str, Mapping[str, float]] | None = None) -> str:
    """Format the verdict for a terminal, conclusion first, with the scores of held-out photos (`predicted_views`)."""
    head = (
        f"{verdict.trust}: relit pictures are expected to reach "
        f"{verdict.expected_relit_db:.0f} ± {verdict.deviation_db:.0f} dB"
    )
    measured = [f"measured: {describe_views(views)}"] if views else []
    reasons = [f"limited by: {why}" for why in verdict.reasons]
    return "\n".join([head, *measured, *reasons, f"next: {verdict.next}", ""])


def _percent(share: float) -> str:
    """Format a share in percent; a share below a hundredth with one digit.

    >>> _percent(0.042), _percent(0.0032)
    ('4%', '0.3%')
    """
    return f"{share:.0%}" if share >= 0.01 else f"{100 * share:.1g}%"


def _explain_materials(inputs: VerdictInputs) -> tuple[str, str]:
    """Return the reason and the next step if materials limit the score."""
    name = max(inputs.materials, key=inputs.materials.__getitem__)
    why = f"uncertain reflectances, most of all that of '{name}'"
    if inputs.deviation > DISAGREES:
        why += f", for shapes and photos disagree by {inputs.deviation:.0f} times their noise"
        return why, _explain_unexplained(inputs)[1]
    light = helpful_light(name in inputs.lit_hard)
    return why, f"add a photo of '{name}' {light}, or in which it stands beside a material that is surer"


def _explain_clipped(inputs: VerdictInputs) -> tuple[str, str]:
    """Return the reason and the next step if clipped values limit the score."""
    name = max(inputs.photos, key=lambda photo: inputs.photos[photo].clipped)
    why = f"clipped values, in '{name}' {_percent(inputs.photos[name].clipped)} of all: they say 'at least' only"
    return why, f"expose '{name}' less, or give the camera's raw file"


def _explain_contour(inputs: VerdictInputs) -> tuple[str, str]:
    """Return the reason and the next step if outlines limit the score."""
    errors = {(photo, name): error for photo, each in inputs.contours.items() for name, error in each.items()}
    photo, name = max(errors, key=errors.__getitem__)
    mend = "mend masks that have holes or lack a piece; else give a mesh that is nearer to it, or a larger photo"
    next_ = f"look at the overlays of '{name}': {mend}; if its pose in '{photo}' is wrong, give keypoints"
    return f"outlines of meshes and masks that differ, most of all those of '{name}' in '{photo}'", next_


def _explain_unexplained(inputs: VerdictInputs) -> tuple[str, str]:
    """Return the reason and the next step if unexplained shading limits the score."""
    name = max(inputs.photos, key=lambda photo: inputs.photos[photo].unexplained)
    share = min(inputs.photos[name].unexplained, 1)
    overlap = min(inputs.overlaps.get(name, {}).values(), default=0.0)
    next_ = "a mesh that is nearer to the objects"
    if share >= MUCH and overlap < FITTING:
        wrong = "its mesh, pose, masks or the names of its materials are wrong, or a program has changed the picture"
        next_ = f"look at the overlay of '{name}' in the report: {wrong}"
    elif share >= MUCH and (inputs.surface or 0.0) > SURFACE_DISAGREES:
        next_ += " inside their outlines, which fit: a scan, or for a hull photos from more sides, above and below"
    elif share >= MUCH:
        wrong = "a material has several colours or finishes, or a program has changed the picture"
        next_ = f"look at the difference picture of '{name}' in the report, for its outlines fit: {wrong}"
    return f"shading that stays unexplained, in '{name}' {_percent(share)} of it", next_


EXPLANATIONS = {
    "materials": _explain_materials,
    "clipped": _explain_clipped,
    "unexplained": _explain_unexplained,
    "contour": _explain_contour,
}
