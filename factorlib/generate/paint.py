"""Paint: factors per channel on the diffuse reflectance of a surface, as functions of position in the mesh's own frame.

A mesh in a material has the same paint in every photo. The material's k_d is the mean over the painted surface: factors
have the arithmetic mean 1 in each channel, weighted by area. They are at least LOWEST and at most HIGHEST, and k_d is
at most what k_s leaves of 1.

Wood has growth rings and fibres. One shell is printed with stripes, dots, checks or blobs, one has a patina. They are
neither the darkest shell nor the brightest, which has no room for brighter paint.
"""

from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.generate.surroundings import Rng
from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.subdivision import subdivide
from factorlib.results.materials import Reflectance

Points = Float[np.ndarray, "n 3"]
Pattern = Callable[[Rng, Points], Float[np.ndarray, "n 3"]]  # log factors up to a constant per channel
SPACING = 0.006  # longest edge of a painted mesh, metres; most are 4 mm long, as wide as a photo's pixel on a chair
LOWEST = 0.3
HIGHEST = 2.0
STEPS = 100  # number of times that factors are scaled to the mean 1 and cut; the error falls by the share of cut ones
EDGE = 0.004  # half the width of the border between ink and ground, metres
BROWN = np.array([0.8, 1.0, 1.25])  # contrast of wood and dirt in each channel
PRINTS = {  # height over the border of ink, for phases a and b across and along
    "stripes": lambda a, b: np.cos(a),
    "checks": lambda a, b: np.cos(a) * np.cos(b),
    "dots": lambda a, b: np.cos(a) + np.cos(b) - 0.8,
    "blobs": lambda a, b: np.cos(a + 2 * np.sin(b / 3)) + np.cos(b + 2 * np.sin(a / 2)) - 0.5,
}


def random_function(rng: Rng, points: Points, size: float) -> Float[np.ndarray, "n 1"]:
    """Draw a smooth function of variance 1, whose correlation is exp(−½ (distance / size)²), and return its values."""
    phases = points @ rng.normal(0, 1 / size, (3, 48)) + rng.uniform(0, 2 * np.pi, 48)
    return np.sqrt(2 / 48) * np.cos(phases).sum(axis=1, keepdims=True)


def wood_grain(rng: Rng, points: Points) -> Float[np.ndarray, "n 3"]:
    """Return log factors of growth rings, 2 cm wide, about an upright axis, and of fibres along it."""
    radius = np.linalg.norm(points[:, [0, 2]] - rng.normal(0, 0.15, 2), axis=1, keepdims=True)
    rings = np.sin(2 * np.pi * (radius / 0.02 + random_function(rng, points * [1, 0.3, 1], 0.06)))
    return (0.3 * rings + 0.15 * random_function(rng, points * [1, 0.06, 1], 0.006)) * BROWN


def print_pattern(rng: Rng, points: Points) -> Float[np.ndarray, "n 3"]:
    """Return log factors of one of PRINTS in an ink of random colour, over the plane of x and y − z."""
    height = PRINTS[str(rng.choice(list(PRINTS)))]
    period = rng.uniform(0.06, 0.1)
    turn = np.exp(1j * rng.uniform(0, np.pi))
    phase = 2 * np.pi / period * (points[:, 0] + 1j * (points[:, 1] - points[:, 2])) * turn
    over = height(phase.real, phase.imag) * period / (2 * np.pi * EDGE)
    return (0.5 + 0.5 * np.clip(over, -1, 1))[:, None] * rng.uniform(np.log(0.35), np.log(0.7), 3)


def patina(rng: Rng, points: Points) -> Float[np.ndarray, "n 3"]:
    """Return log factors of dirt: smooth noise of two sizes."""
    return (0.3 * random_function(rng, points, 0.05) + 0.15 * random_function(rng, points, 0.015)) * BROWN


def choose_patterns(seed: int, materials: Mapping[str, Reflectance]) -> dict[str, Pattern]:
    """Return the pattern of each painted material: wood, and two of the other four."""
    shells = sorted((name for name in materials if name != "wood"), key=lambda name: materials[name].total)
    printed, weathered = np.random.default_rng([17, seed]).permutation(shells[1:-1])
    return {"wood": wood_grain, str(printed): print_pattern, str(weathered): patina}


def paint_mesh(mesh: Mesh, seed: int, materials: Mapping[str, Reflectance]) -> Mesh:
    """Subdivide a mesh and give it the detail of its materials' paint, 1 where there is none.

    Args:
        mesh: Mesh, in metres; its labels are positions in `materials`, and no vertex has faces of two materials.
        seed: Seed of the set.
        materials: Materials by name.

    Returns:
        The mesh with detail.
    """
    fine = subdivide(mesh, SPACING)
    area = np.repeat(np.linalg.norm(area_vectors(fine.vertices, fine.faces), axis=1), 3)
    detail = np.ones_like(fine.vertices)
    patterns = choose_patterns(seed, materials)
    for label, (name, material) in enumerate(materials.items(), start=1):
        if name in patterns and label in fine.labels:
            used = np.unique(fine.faces[fine.face_label == label])
            factor = np.exp(patterns[name](np.random.default_rng([17, seed, label]), fine.vertices[used]))
            weight = np.bincount(fine.faces.reshape(-1), area)[used]
            highest = np.minimum(HIGHEST, 1 / np.array(material.mixture[1]))
            for _ in range(STEPS):
                factor = np.clip(factor / np.average(factor, axis=0, weights=weight), LOWEST, highest)
            detail[used] = factor
    return msgspec.structs.replace(fine, detail=detail)
