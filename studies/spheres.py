"""Materials and lights of a seed, spheres of the ones in the others, and what a case observes of them.

Materials  about those of `ABOUT`, each number times exp(.15 · normal).
Lights     by the project's own generator (`factorlib.generate`): the first of a world is a street by day, the others
           are rooms. Mean radiance 1.
Radiance   by quadrature of the lights' maps (`factorlib.evaluate.ball`), not by the operator that solves: what a solve
           is judged on is not made by its own approximations.
Noise      each radiance times 1 + noise · normal, .01 as a rule, drawn for each entry by itself, so that an entry that
           two cases show has the same noise in both.
Normals    perturbed after rendering: the solve gets a normal that is not the pixel's.
Labels     likewise: the pixel is of one material, its label names another one of the same photo.
Facets     rendered so: a flat-sided object, whose normals are true but few.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from factorlib.conventions import FRONT, YUP_FROM_CAMERA
from factorlib.evaluate.ball import OctahedralLight, ball
from factorlib.generate.surroundings import random_materials
from factorlib.generate.synthetic import light_of
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import read_rgb_exr
from factorlib.results.materials import Reflectance
from factorlib.scenes.joint_problems import observations_from_front
from factorlib.tracing.scene import look
from factorlib.urm.observations import Observations
from studies.study import SEVEN, Case, light_name

ABOUT = {  # by the names of `SEVEN`
    "brick": Reflectance((0.5, 0.12, 0.1), (0.08, 0.08, 0.08), 0.6),
    "leaf": Reflectance((0.1, 0.35, 0.14), (0.25, 0.25, 0.25), 0.35),
    "lacquer": Reflectance((0.12, 0.16, 0.24), (0.4, 0.4, 0.4), 0.22),
    "chalk": Reflectance((0.6, 0.58, 0.52), (0.04, 0.04, 0.04), 0.7),
    "gold": Reflectance((0.15, 0.1, 0.04), (0.6, 0.45, 0.2), 0.3),
    "tile": Reflectance((0.34, 0.4, 0.5), (0.15, 0.15, 0.15), 0.45),
    "bronze": Reflectance((0.2, 0.13, 0.06), (0.5, 0.34, 0.14), 0.38),
}
SPREAD = 0.15
GRAZING = 0.15  # n·o below which no pixel is observed
STEEPEST = 0.25  # n·o of the faces that are observed at the flattest angle
CURVED = 0.1  # share of a face's normals that is the sphere's: no real face is exactly flat


def materials_of(seed: int, names: Sequence[str] = SEVEN[:5]) -> dict[str, Reflectance]:
    """Return the materials of a world by name."""
    return random_materials(np.random.default_rng([11, seed]), SPREAD, {name: ABOUT[name] for name in names})


def light_map(seed: int, light: int, rows: int, spp: int) -> Float[np.ndarray, "h w 3"]:
    """Return light number `light` of a world, lat-long in the camera's y-up frame, mean radiance 1.

    It is the same however many others there are.
    """
    rng = np.random.default_rng([12, seed, light])
    world_from_camera = look(rng.uniform(-14, -6), rng.uniform(0, 360))
    lamps = 1 + light % 2 if light else 0  # none: by day
    radiance = light_of(lamps, world_from_camera, [], rng, rows, spp)
    return (radiance / radiance.mean()).astype(np.float32)


def read_maps(worlds: Path, seed: int, lights: Iterable[int]) -> dict[int, Float[np.ndarray, "h w 3"]]:
    """Read the maps of lights of a world, by number, from the folder of the step `worlds`."""
    return {li: read_rgb_exr(worlds / f"{seed}-{li}.exr") for li in lights}


def sphere_normals(size: int) -> Float[np.ndarray, "n 3"]:
    """Return normals in the light's frame of a sphere `size` pixels across, seen orthographically.

    Grazing ones are left out.
    """
    normals, _ = ball_normals(size)
    return normals[normals[:, 2] > GRAZING]


def in_camera(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Turn normals of the light's frame into the camera's."""
    return normals @ YUP_FROM_CAMERA.T


# ── what a case observes ─────────────────────────────────────────────────────────────────────────────────────────────


def observations_of(
    case: Case, materials: Mapping[str, Reflectance], lights: Mapping[int, OctahedralLight]
) -> dict[str, Observations]:
    """Return one photo a light, by name, in the form in which the stage `urm` hands them to `solve`."""
    return {light_name(li): _photo(case, li, list(materials.values()), lights[li]) for li in case.lights}


def _photo(case: Case, number: int, materials: Sequence[Reflectance], light: OctahedralLight) -> Observations:
    rows = [m for m, li in case.entries if li == number]
    normals = faceted(sphere_normals(case.size), case.facets)
    index = case.materials.index

    def rng(m: int, what: str) -> np.random.Generator:
        return np.random.default_rng([13, case.seed, number, m, ("noise", "normals", "labels").index(what)])

    exact = [ball(light, materials[m], normals) for m in rows]
    noisy = [r * (1 + case.noise * rng(m, "noise").standard_normal(r.shape)) for m, r in zip(rows, exact, strict=True)]
    turned = [tilted(in_camera(normals), case.normal_deg, rng(m, "normals")) for m in rows]
    others = [index(m) for m in rows]
    labels = [mislabelled(len(normals), index(m), others, case.wrong_labels, rng(m, "labels")) for m in rows]
    columns = (np.concatenate(turned), np.concatenate(noisy), np.concatenate(labels))
    return observations_from_front(*columns, tuple(case.material_names), light_name(number))


def tilted(normals: Float[np.ndarray, "n 3"], degrees: float, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Turn each normal by |N(0, degrees)| toward a random side, at most until it is seen at a grazing angle."""
    side = np.cross(normals, rng.normal(size=normals.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.radians(degrees * np.abs(rng.normal(size=len(normals))))[:, None]
    turned = np.cos(angle) * normals + np.sin(angle) * side
    return np.where((turned @ FRONT > GRAZING)[:, None], turned, normals)


def mislabelled(
    n: int, label: int, labels: Sequence[int], share: float, rng: np.random.Generator
) -> Int[np.ndarray, " n"]:
    """Return the label of each pixel: for `share` of them another one of `labels`, where there is any."""
    others = [other for other in labels if other != label]
    wrong = rng.random(n) < share
    return np.where(wrong, rng.choice(others, n), label) if others else np.full(n, label)


def faceted(normals: Float[np.ndarray, "n 3"], facets: int | None) -> Float[np.ndarray, "n 3"]:
    """Return normals of a convex object that shows so many flat faces (`face_normals`).

    Each pixel has the normal of the face that is nearest to the sphere's, but for `CURVED` of the way.
    """
    if facets is None:
        return normals
    faces = face_normals(facets)
    flat = (1 - CURVED) * faces[(normals @ faces.T).argmax(axis=1)] + CURVED * normals
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    return flat[flat[:, 2] > GRAZING]


def face_normals(facets: int) -> Float[np.ndarray, "k 3"]:
    """Return normals of faces spread evenly over the cap of n·z > `STEEPEST` about the viewer's z.

    One face alone looks straight at the viewer.
    """
    if facets == 1:
        return np.array([[0.0, 0.0, 1.0]])
    z = 1 - (1 - STEEPEST) * (np.arange(facets) + 0.5) / facets
    turn = np.arange(facets) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=-1)
