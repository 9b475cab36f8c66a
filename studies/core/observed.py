"""What a case sees: pixels of spheres with noise, in the form in which the stage `urm` hands them to `solve`.

Noise     each radiance times 1 + .01 · normal, drawn for each entry by itself, so that an entry that two cases show has
          the same noise in both.
Normals   perturbed after rendering: the solve gets a normal that is not the pixel's.
Labels    likewise: the pixel is of one material, its label names another one of the same photo.
Facets    rendered so: a flat-sided object, whose normals are true but few.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from factorlib.conventions import FRONT
from factorlib.evaluate.ball import Light
from factorlib.results.materials import Reflectance
from factorlib.urm.observations import Observations
from studies.core.case import Case, light_name
from studies.core.world import GRAZING, in_camera, sphere_normals, spheres

NOISE = 0.01  # of a radiance
STEEPEST = 0.25  # n·o of the faces that are seen at the flattest angle
CURVED = 0.1  # share of a face's normals that is the sphere's: no real face is exactly flat


def observations_of(
    case: Case, materials: Mapping[str, Reflectance], lights: Mapping[int, Light]
) -> dict[str, Observations]:
    """One photo a light, by name."""
    return {light_name(light): _photo(case, light, list(materials.values()), lights[light]) for light in case.lights}


def _photo(case: Case, number: int, materials: Sequence[Reflectance], light: Light) -> Observations:
    shown = [m for m, li in case.entries if li == number]
    normals = faceted(sphere_normals(case.size), case.facets)
    radiance = spheres([materials[m] for m in shown], light, normals)
    for m, sphere in zip(shown, radiance, strict=True):
        sphere *= 1 + NOISE * _random(case, number, m, "noise").standard_normal(sphere.shape)
    n, names, photo = radiance.shape[0] * radiance.shape[1], tuple(case.material_names), (light_name(number),)
    seen = np.concatenate(
        [tilted(in_camera(normals), case.normal_deg, _random(case, number, m, "normals")) for m in shown]
    )
    labels = [mislabelled(len(normals), case.materials.index(m), [case.materials.index(s) for s in shown], case.wrong_labels,
                          _random(case, number, m, "labels")) for m in shown]  # fmt: skip
    zero = np.zeros(n, int)
    return Observations(
        normal=seen, view=np.tile(FRONT, (n, 1)), radiance=radiance.reshape(-1, 3), clipped=np.zeros((n, 3), bool),
        material=np.concatenate(labels), photo=zero, illumination=zero, x=np.arange(n), y=zero, weight=np.ones(n),
        materials=names, photos=photo, illuminations=photo,
    )  # fmt: skip


def _random(case: Case, light: int, material: int, what: str) -> np.random.Generator:
    return np.random.default_rng([13, case.seed, light, material, ("noise", "normals", "labels").index(what)])


def tilted(normals: Float[np.ndarray, "n 3"], degrees: float, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Each normal turned by |N(0, degrees)| toward a random side, at most until it is seen at a grazing angle."""
    side = np.cross(normals, rng.normal(size=normals.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.radians(degrees * np.abs(rng.normal(size=len(normals))))[:, None]
    turned = np.cos(angle) * normals + np.sin(angle) * side
    return np.where((turned @ FRONT > GRAZING)[:, None], turned, normals)


def mislabelled(
    n: int, label: int, shown: Sequence[int], share: float, rng: np.random.Generator
) -> Int[np.ndarray, " n"]:
    """The label of each pixel: for `share` of them another one of `shown`, where there is any."""
    others = [other for other in shown if other != label]
    wrong = rng.random(n) < share
    return np.where(wrong, rng.choice(others, n), label) if others else np.full(n, label)


def faceted(normals: Float[np.ndarray, "n 3"], facets: int | None) -> Float[np.ndarray, "n 3"]:
    """Normals of a convex object that shows so many flat faces (`face_normals`).

    Each pixel has the normal of the face that is nearest to the sphere's, but for `CURVED` of the way.
    """
    if facets is None:
        return normals
    faces = face_normals(facets)
    flat = (1 - CURVED) * faces[(normals @ faces.T).argmax(axis=1)] + CURVED * normals
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    return flat[flat[:, 2] > GRAZING]


def face_normals(facets: int) -> Float[np.ndarray, "k 3"]:
    """Of so many faces, evenly over the cap of n·z > `STEEPEST` about the viewer's z; one face alone looks straight at the viewer."""
    if facets == 1:
        return np.array([[0.0, 0.0, 1.0]])
    z = 1 - (1 - STEEPEST) * (np.arange(facets) + 0.5) / facets
    turn, radius = np.arange(facets) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=-1)
