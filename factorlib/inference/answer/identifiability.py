"""Warnings about missing, unusable or undetermined quantities.

They follow from the observations alone, from the standard errors of the answer, and from large residuals.  Every
sentence names what is not determined, the reason, and a photo that would help.  No warning stops the solve.  The factor
per channel between reflectances and lights is the subject of `factorlib.inference.model.gauge`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from factorlib.geometry.sphere import mirror_directions
from factorlib.inference.answer.answer import Answer
from factorlib.inference.fit.exposures import material_groups
from factorlib.inference.model.blocks import Block
from factorlib.inference.model.gauge import LEAST_ENERGY, connected_components, has_free_factor
from factorlib.inference.model.materials import REFLECTANCES, ROUGHNESS, Materials, Point
from factorlib.inference.model.observed import PhotoObservations
from factorlib.inference.model.problem import JointProblem
from factorlib.light.lobes import is_hard
from factorlib.robust import TINY

FEW_OBSERVATIONS = 40  # observations: a few for each of 7 unknowns of a material and for the light that it mirrors
LEAST_SPREAD_DEG = 15.0  # mirror directions within this angle of their mean show one patch of the light
CLIPPED = 0.5  # share of clipped channel values
ROUGHNESS_ERROR = 0.1  # largest standard error that still separates dull from glossy
SHARE_ERROR = 0.25  # largest standard error, as a share of a material's diffuse + specular reflectance
DARK_BOUND = 0.1  # largest bound on reflectance that still means 'dark'
# Largest mean |log R/G| or |log B/G|: three standard deviations of the colour of one light (docs/light-prior.md).
LARGEST_TINT = 0.6
EXPOSURE_DIFFERS = 1.5  # largest factor between estimated and EXIF exposure without a warning
OUTLIER = 3.0  # residual in σ of the noise model
OUTLIERS = 0.1  # largest share of such residuals without a warning


def unusable_observations(photos: Sequence[PhotoObservations]) -> list[str]:
    """Return a sentence for each photo with unusable observations."""
    return [
        f"photo '{', '.join(photo.merged.photos)}': {photo.unusable} of {photo.count} observations are left out, "
        "their radiance, normal or view not finite or their weight not positive"
        for photo in photos
        if photo.unusable
    ]


def before_solving(names: Sequence[str], photos: Sequence[str], problem: JointProblem) -> list[str]:
    """Return sentences about missing observations and quantities that they cannot determine.

    Args:
        names: Names of all materials, by number.
        photos: Names of all photos.
        problem: Observations.
    """
    observed = {int(m) for block in problem.blocks for m in np.unique(block.material)}
    unseen = [name for m, name in enumerate(names) if m not in observed and m not in problem.known.materials]
    sentences = [f"material '{name}' is observed in no photo: its reflectance is only a guess" for name in unseen]
    dark = sorted(set(photos) - {photo for block in problem.blocks for photo in block.photos})
    sentences += [f"photo '{photo}' has no valid observation and gets no light" for photo in dark]
    linked = [component for component in connected_components(problem.blocks, len(names)) if component.illuminations]
    if len(linked) > 1 and any(problem.known.free_factors(*component) for component in linked):
        linked_names = ((", ".join(lights), ", ".join(names[m] for m in members)) for members, lights in linked)
        groups = "; ".join(f"{lights} (with {materials})" for lights, materials in linked_names)
        sentences.append(
            f"the photos fall into {len(linked)} sets that share no material, so their reflectances cannot be "
            f"compared: {groups}. An object that is left out of the solve may link them, once its pose is good; else "
            "a photo that shows a material of each would"
        )
    group = material_groups(problem.blocks, len(names), problem.known)
    for component in linked:
        apart = sorted({int(group[m]) for m in component.materials})
        if len(apart) > 1 and problem.known.free_factors(*component) == 3:
            members = "; ".join(", ".join(n for m, n in enumerate(names) if group[m] == g) for g in apart)
            sentences.append(
                "photos of one light show different materials, so that a longer exposure and a brighter material look "
                f"alike: the relative brightness of {members} rests on the assumption of similar exposures. If the "
                "camera's exposure was fixed, write `known: {exposure: {<photo>: 0, …}}` for all photos of a light"
            )
    return sentences + undetermined_by_observations(names, problem)


def undetermined_by_observations(names: Sequence[str], problem: JointProblem) -> list[str]:
    """Return sentences about quantities that no solve can determine.

    Known materials and materials without observations are left out.
    """
    black = [block.name for block in problem.blocks if (block.radiance <= 0).all()]
    sentences = [f"illumination '{name}' is black in every photo: it tells nothing" for name in black]
    for m, name in enumerate(names):
        observations = [block.take(block.material == m) for block in problem.blocks if (block.material == m).any()]
        sentences += _material_warnings(name, observations) if observations and m not in problem.known.materials else []
    for members, lights in connected_components(problem.blocks, len(names)):
        if len(members) == 1 and lights and problem.known.free_factors(members, lights) == 3:
            consequence = (
                ", and a smooth material in a soft light looks like a rough one in a sharp light. "
                "A photo of it in other light"
            )
            free = has_free_factor(problem.blocks, lights)
            source = "by convention only" if free else "to about a quarter, by surroundings or light between surfaces"
            sentences.append(
                f"material '{names[members[0]]}' shares no light with another: its colour and brightness are "
                f"separated from the light's {source}{consequence if len(lights) == 1 else '. A photo'} that "
                "shows another material too would help"
            )
    return sentences


def _material_warnings(name: str, observations: Sequence[Block]) -> Iterator[str]:
    """Yield sentences about one material from its observations in each light."""
    count = sum(map(len, observations))
    if count < FEW_OBSERVATIONS:
        yield (
            f"material '{name}' has {count} observation(s), fewer than {FEW_OBSERVATIONS}: its reflectance is "
            "uncertain, and its roughness more so. A photo from nearer would help"
        )
    if all(_spread(block) < LEAST_SPREAD_DEG for block in observations):
        yield (
            f"material '{name}' is flat: in every light it mirrors one direction only, so its roughness and what of "
            "it is specular cannot be determined. A photo of a curved part, or several of it turned in a light that "
            "is fixed to the world, would help"
        )
    clipped = np.concatenate([block.clipped for block in observations]).mean()
    if clipped >= CLIPPED:
        yield (
            f"{clipped:.0%} of the values of material '{name}' are clipped and say 'at least' only: its reflectance "
            "is uncertain. A photo of shorter exposure would help"
        )


def _spread(block: Block) -> float:
    """Return the largest angle between a mirror direction and their mean, degrees."""
    mirror = mirror_directions(block.normal, block.view)
    mean = mirror.mean(0)
    return float(np.degrees(np.arccos(np.clip(mirror @ mean / max(np.linalg.norm(mean), TINY), -1, 1)).max()))


def after_solving(answer: Answer) -> list[str]:
    """Return sentences about quantities that the answer leaves open or explains badly."""
    problem = answer.solution.effective_problem(answer.problem)
    return [
        *undetermined_by_answer(answer.names, problem, answer.solution.point, answer.errors.materials),
        *poorly_explained(problem, answer.radiance),
        *unlikely_curves(problem, answer.solution.point),
        *tinted_alike(problem, answer.solution.point),
        *_brighter_than_white(answer),
        *_exposures_unlike_exif(answer),
    ]


def undetermined_by_answer(names: Sequence[str], problem: JointProblem, point: Point, errors: Materials) -> list[str]:
    """Return sentences about observed materials that the data leave uncertain.

    Args:
        names: Names of all materials, by number.
        problem: Observations.
        point: Estimated materials and lights.
        errors: Standard errors of the materials.
    """
    lit_hard: dict[int, bool] = {}
    for block, light in zip(problem.blocks, point.lights, strict=True):
        hard = is_hard(light.axis, light.energy.sum(1))
        lit_hard |= {int(m): hard or lit_hard.get(int(m), False) for m in np.unique(block.material)}
    estimates, deviations = point.materials.rows(), errors.rows()
    return [
        sentence
        for m, hard in sorted(lit_hard.items())
        for sentence in _error_warnings(names[m], estimates[m], deviations[m], hard)
    ]


def helpful_light(lit_hard: bool) -> str:
    """Return the light, in words, in which a photo tells more of a material that was seen in hard light, or was not."""
    return "in another light" if lit_hard else "in light with a small bright source"


def _error_warnings(
    name: str, estimate: Float[np.ndarray, "7"], error: Float[np.ndarray, "7"], lit_hard: bool
) -> Iterator[str]:
    """Yield sentences about one material from its estimate and standard errors, both (k_d, k_s, roughness)."""
    reflectance = (estimate[:3] + estimate[3:REFLECTANCES]).max()
    *errors, roughness_error = error.tolist()
    largest = max(errors)
    specular = estimate[3:REFLECTANCES]
    if reflectance < largest <= DARK_BOUND:
        yield (
            f"material '{name}' is so dark that of its reflectance only a bound, about "
            f"{reflectance + 2 * largest:.2g}, can be given. A photo of longer exposure would help"
        )
    elif not largest <= SHARE_ERROR * reflectance:
        yield (
            f"the reflectance of material '{name}' is known to ±{largest:.2g} only, of {reflectance:.2g}: diffuse and "
            f"specular part look alike here. A photo {helpful_light(lit_hard)}, or next to a brighter material, would "
            "help"
        )
    if not (specular.any() or error[3:REFLECTANCES].any()):  # k_s is known to be 0: roughness has no meaning
        return
    if not (roughness_error <= ROUGHNESS_ERROR and (specular > 2 * error[3:REFLECTANCES]).any()):
        yield (
            f"the roughness of material '{name}' cannot be determined (±{roughness_error:.2g}): no highlight "
            f"stands out, or shape and photos disagree too much. A photo {helpful_light(lit_hard)}, or a better mesh, "
            "would help"
        )
    elif estimate[REFLECTANCES] <= ROUGHNESS[0] + 1e-9 and roughness_error > 0:
        yield (
            f"the roughness of material '{name}' is at {ROUGHNESS[0]:g}, the least the model knows: it may be smoother"
        )


def poorly_explained(problem: JointProblem, radiance: Sequence[Float[np.ndarray, "n 3"]]) -> Iterator[str]:
    """Yield a sentence for each illumination with many residuals far beyond the noise model."""
    for block, predicted in zip(problem.blocks, radiance, strict=True):
        residual = block.residuals(predicted)
        share = float((np.abs(residual * (block.inverse_sigma > 0)) > OUTLIER).mean())
        if share > OUTLIERS:
            yield (
                f"illumination '{block.name}': {share:.0%} of the values differ from the answer by more than "
                f"{OUTLIER:g} times their noise. Look at what `align` drew: wrong normals, poses or masks there make "
                "every material in it wrong"
            )


def unlikely_curves(problem: JointProblem, point: Point) -> Iterator[str]:
    """Yield a sentence for each light whose tone curves end near the bounds of real cameras."""
    for block, light in zip(problem.blocks, point.lights, strict=True):
        if light.implausible_tone:
            exponents = ", ".join(f"{g:.2g}" for g in np.exp(light.log_tone))
            yield (
                f"the tone curves of illumination '{block.name}' have exponents of {exponents}, more than a camera "
                'does: something else is wrong there, as normals or `encoding`. SET="solve.tone=off" goes without '
                "them"
            )


def tinted_alike(problem: JointProblem, point: Point) -> Iterator[str]:
    """Yield a sentence for each set of lights with a strong common tint, fixed by interreflection or a background.

    There is none where the gauge of `factorlib.inference.model.gauge` makes lights grey, or where a material or a light
    is known.
    """
    for members, illuminations in connected_components(problem.blocks, len(point.materials)):
        if (
            not illuminations
            or problem.known.free_factors(members, illuminations) < 3
            or has_free_factor(problem.blocks, illuminations)
        ):
            continue
        pairs = zip(problem.blocks, point.lights, strict=True)
        sums = np.array([light.energy.sum(0) for block, light in pairs if block.name in illuminations])
        level = np.log(np.maximum(sums, LEAST_ENERGY * sums.max(1, keepdims=True))).mean(0)
        if np.abs(level - level[1]).max() > LARGEST_TINT:
            colour = " : ".join(f"{c:.2g}" for c in np.exp(level - level.mean()))
            yield (
                f"the lights of {', '.join(illuminations)} are R : G : B = {colour} on average, as interreflection "
                "or the surroundings in the photos fix it: reflectances have the opposite colour, if the lights were "
                "nearly white. "
                'SET="solve.interreflection=off solve.background=off" makes the lights grey'
            )


def _brighter_than_white(answer: Answer) -> Iterator[str]:
    """Yield a sentence for each material brighter than white beside known ones."""
    materials = answer.solution.point.materials
    reflectances = (materials.diffuse.max(1) + materials.specular.max(1)).tolist()
    for name, reflectance in zip(answer.names, reflectances, strict=True):
        if reflectance > 1 and not answer.problem.known.is_empty:
            yield (
                f"material '{name}' comes out with diffuse + specular = {reflectance:.2f} beside what is known, more "
                "than falls on it: are the known reflectances right, and of materials that the same light falls on?"
            )


def _exposures_unlike_exif(answer: Answer) -> Iterator[str]:
    """Yield a sentence for each photo whose estimated exposure differs from its EXIF."""
    for photo, factor in answer.estimated_exposures().items():
        by_exif = answer.relative[photo]
        if by_exif != 1 and abs(np.log(factor)) > np.log(EXPOSURE_DIFFERS):
            yield (
                f"photo '{photo}': by its EXIF its exposure is {by_exif:.3g} of its light's first photo, by its "
                f"pixels {factor * by_exif:.3g}: was it made brighter or darker later?"
            )
