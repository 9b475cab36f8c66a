"""Spheres of a world's materials in its lights: what a case of a study observes, and what a camera sees of them.

Materials  those of `TYPICAL`, each number times exp(0.15 · normal).
Lights     by the project's own generator (`factorlib.generate`): the first of a world is a street by day, the others
           are rooms.  Mean radiance 1.
Radiance   by quadrature of the lights' maps (`factorlib.evaluate.ball`), not by the operator that solves, whose errors
           the comparison with the truth must include.
Noise      each radiance times 1 + noise · normal, 0.01 as a rule, independent of the case's other entries: an entry has
           the same noise in all cases.
Normals    perturbed after rendering: the solve gets a normal that is not the pixel's.
Labels     likewise: a wrong label names another material of the same photo.
Facets     rendered so: a flat-sided object, whose normals are true but few.

Points and normals of a sphere of radius 1 are equal, in the photo's light frame (x right, y up, z toward the viewer).
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from factorlib.conventions import FRONT, YUP_FROM_CAMERA
from factorlib.evaluate.ball import OctahedralLight, ball, octahedral_light
from factorlib.generate.surroundings import random_materials
from factorlib.generate.synthetic import photo_light
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import read_rgb_exr
from factorlib.light.latlong import rotate_map
from factorlib.results.materials import Reflectance
from factorlib.scenes.joint_problems import observations_from_front
from factorlib.tracing.scene import look_rotation
from factorlib.urm.observations import Observations
from studies.study import SEVEN, Case, Comparison, light_name

Map = Float[np.ndarray, "h w 3"]
Maps = Mapping[int, Map]
Normals = Float[np.ndarray, "n 3"]
Radiance = Float[np.ndarray, "n 3"]
TYPICAL = {  # by the names of `SEVEN`
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
SUPERSAMPLING = 2  # samples along a texel's side where a map is turned


def materials_of(seed: int, names: Sequence[str] = SEVEN[:5]) -> dict[str, Reflectance]:
    """Return the materials of a world by name."""
    return random_materials(np.random.default_rng([11, seed]), SPREAD, {name: TYPICAL[name] for name in names})


def light_map(seed: int, light: int, rows: int, spp: int) -> Map:
    """Return light number `light` of a world, lat-long in the camera's y-up frame, mean radiance 1.

    It does not depend on the number of other lights.
    """
    rng = np.random.default_rng([12, seed, light])
    world_from_camera = look_rotation(rng.uniform(-14, -6), rng.uniform(0, 360))
    lamps = 1 + light % 2 if light else 0  # none: by day
    radiance = photo_light(lamps, world_from_camera, [], rng, rows, spp)
    return (radiance / radiance.mean()).astype(np.float32)


def read_maps(worlds: Path, seed: int, lights: Iterable[int]) -> dict[int, Map]:
    """Read the maps of lights of a world, by number, from the folder of the step `worlds`."""
    return {li: read_rgb_exr(worlds / f"{seed}-{li}.exr") for li in lights}


# ── observations ─────────────────────────────────────────────────────────────────────────────────────────────────────


def observe_spheres(
    case: Case, materials: Mapping[str, Reflectance], lights: Mapping[int, OctahedralLight]
) -> dict[str, Observations]:
    """Return the observations of one photo for each light, by name, in the form that the stage `urm` writes."""
    return {light_name(li): _photo(case, li, list(materials.values()), lights[li]) for li in case.lights}


def _photo(case: Case, number: int, materials: Sequence[Reflectance], light: OctahedralLight) -> Observations:
    entries = [m for m, li in case.entries if li == number]
    labels = [case.materials.index(m) for m in entries]
    normals = facet_normals(sphere_view(case.size).normals, case.facets)
    columns = []
    for m, label in zip(entries, labels, strict=True):
        noise, tilt, mislabel = (np.random.default_rng([13, case.seed, number, m, k]) for k in range(3))
        radiance = ball(light, materials[m], normals)
        noisy = radiance * (1 + case.noise * noise.standard_normal(radiance.shape))
        turned = tilt_normals(normals @ YUP_FROM_CAMERA.T, case.normal_deg, tilt)
        columns.append((turned, noisy, mislabel_pixels(len(normals), label, labels, case.wrong_labels, mislabel)))
    photo = map(np.concatenate, zip(*columns, strict=True))
    return observations_from_front(*photo, tuple(case.material_names), light_name(number))


def tilt_normals(normals: Normals, degrees: float, rng: np.random.Generator) -> Normals:
    """Turn each normal by |N(0, degrees)| toward a random side, at most until it is seen at a grazing angle."""
    side = np.cross(normals, rng.normal(size=normals.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.radians(degrees * np.abs(rng.normal(size=len(normals))))[:, None]
    turned = np.cos(angle) * normals + np.sin(angle) * side
    return np.where((turned @ FRONT > GRAZING)[:, None], turned, normals)


def mislabel_pixels(
    n: int, label: int, labels: Sequence[int], share: float, rng: np.random.Generator
) -> Int[np.ndarray, " n"]:
    """Return the label of each pixel, replaced for a `share` of them by another of `labels`, if there is any."""
    others = [other for other in labels if other != label]
    wrong = rng.random(n) < share
    return np.where(wrong, rng.choice(others, n), label) if others else np.full(n, label)


def facet_normals(normals: Normals, facets: int | None) -> Normals:
    """Return normals of a convex object with `facets` visible flat faces (`polyhedron_normals`).

    Each pixel has the normal of the face that is nearest to the sphere's, but for `CURVED` of the way.
    """
    if facets is None:
        return normals
    faces = polyhedron_normals(facets)
    flat = (1 - CURVED) * faces[(normals @ faces.T).argmax(axis=1)] + CURVED * normals
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    return flat[flat[:, 2] > GRAZING]


def polyhedron_normals(facets: int) -> Float[np.ndarray, "k 3"]:
    """Return normals of faces spread evenly over the cap of n·z > `STEEPEST` about the viewer's z.

    One face alone looks straight at the viewer.
    """
    if facets == 1:
        return np.array([[0.0, 0.0, 1.0]])
    z = 1 - (1 - STEEPEST) * (np.arange(facets) + 0.5) / facets
    turn = np.arange(facets) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=-1)


# ── views ────────────────────────────────────────────────────────────────────────────────────────────────────────────


class SphereView(msgspec.Struct, frozen=True):
    """Points of the sphere that a camera sees: the pixels `inside` of its picture, in rows.

    A camera that went around the sphere is given by `rotation`, view_from_photo; the sphere and its light stay.
    normals: in the photo's light frame
    """

    inside: Bool[np.ndarray, "h w"]
    normals: Normals
    rotation: Float[np.ndarray, "3 3"]

    def picture(self, radiance: Radiance) -> Map:
        """Return the points' radiance in their pixels, 0 elsewhere."""
        pixels = np.zeros((*self.inside.shape, 3))
        pixels[self.inside] = radiance
        return pixels

    def render(self, material: Reflectance, light: Map) -> Radiance:
        """Render the sphere in a light by quadrature of the map, turned into the frame of a camera that went around."""
        ahead = np.array_equal(self.rotation, np.eye(3))
        light = light if ahead else rotate_map(light, self.rotation, SUPERSAMPLING)
        return ball(octahedral_light(light), material, self.normals @ self.rotation.T)


def sphere_view(size: int, azimuth_deg: float = 0.0, elevation_deg: float = 0.0) -> SphereView:
    """Return the view, `size` pixels across, of a camera that went to the right, then up; grazing pixels are left out.

    >>> sphere_view(8, 90, 0).rotation.round(6).tolist()[2]
    [1.0, 0.0, 0.0]
    """
    rotation = Rotation.from_euler("yx", [-azimuth_deg, elevation_deg], degrees=True).as_matrix()
    normals, inside = ball_normals(size)
    inside[inside] = visible = normals[:, 2] > GRAZING
    return SphereView(inside, normals[visible] @ rotation, rotation)


class Photos(msgspec.Struct, frozen=True):
    """Photos that all methods of the comparison see: the sphere, and its radiance by material's name and light."""

    view: SphereView
    radiance: dict[tuple[str, int], Radiance]

    @property
    def materials(self) -> list[str]:
        """Names of the materials, in order of their first photo."""
        return list(dict.fromkeys(name for name, _ in self.radiance))

    @property
    def lights(self) -> list[int]:
        """Numbers of the lights, sorted."""
        return sorted({light for _, light in self.radiance})


def photograph(
    case: Comparison, materials: Mapping[str, Reflectance], lights: Maps
) -> tuple[Photos, dict[str, Observations]]:
    """Return the photos of a case, and their observations in the form that the stage `urm` writes."""
    tables = observe_spheres(case, materials, {li: octahedral_light(lights[li]) for li in case.lights})
    radiance = {
        (name, li): table.radiance[table.material == table.materials.index(name)]
        for li, table in zip(case.lights, tables.values(), strict=True)
        for name in case.names_in(li)
    }
    return Photos(sphere_view(case.size), radiance), tables
