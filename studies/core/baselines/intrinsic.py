"""An intrinsic decomposition, in the spirit of SIRFS (Barron and Malik 2015): albedo × shading + highlight, albedos averaged over photos.

It knows the normals, and which pixels are of which material; each photo is decomposed by itself.

Shading    S(n) = Σ e_lm Y_lm(n), nine spherical harmonics: what Lambert reflects of a distant light to within a few per cent
           (Ramamoorthi and Hanrahan 2001).  All objects of a photo share it.
Albedo     a, one a material and channel: in turn with e by weighted least squares of I − a S.
Highlight  max(I − a S, 0).  So that it does not pull at albedo and shading, a pixel's weight is 1 / (1 + (r/s)²) where its residual
           r is positive in the mean over channels, s the median size of those that are negative, or `LEAST` of the mean if that is more.
Average    a photo determines albedos but for a factor per channel: ln a_mi = α_m + β_i in least squares over photos i.  α is the answer,
           β goes into the photo's shading.
New light  its own nine coefficients shade the albedo; the highlight stays on the surface as it is, the mean over photos.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.results.materials import Reflectance
from studies.core.baselines.body import Seen
from studies.core.baselines.gauge import lambertian_part
from studies.core.baselines.photos import Photos
from studies.core.baselines.projective import Texture
from studies.core.baselines.scene import Map, Radiance, Scene
from studies.core.gauge import factor_of

LAMBERT = np.array(
    [1, *[2 / 3] * 3, *[1 / 4] * 5]
)  # A_l / π: what a white Lambert surface reflects of each harmonic of a light
ITERATIONS, LEAST, DARKEST = 60, 0.01, 1e-4
ROWS = 32  # of the map of a recovered light

Coefficients = Float[np.ndarray, "9 3"]


def harmonics(directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 9"]:
    """The nine real, orthonormal spherical harmonics of degree 0, 1 and 2."""
    x, y, z = np.moveaxis(directions, -1, 0)
    one, two, three, four = np.sqrt(np.array([1, 3, 15, 5]) / (4 * np.pi))
    flat = [one * np.ones_like(x), two * y, two * z, two * x, three * x * y, three * y * z]
    return np.stack([*flat, four * (3 * z * z - 1) / 2, three * x * z, three * (x * x - y * y) / 2], axis=-1)


def light_coefficients(light: Map) -> Coefficients:
    """∫ L Y over the sphere."""
    height, width = light.shape[:2]
    return np.einsum(
        "h,hwk,hwc->kc", lat_long_solid_angles(height, width), harmonics(lat_long_directions(height, width)), light
    )


class Decomposed(msgspec.Struct, frozen=True):
    """A photo: shading's coefficients, and each material's albedo, but for one factor per channel between them; highlights [n, 3]."""

    shading: Coefficients
    albedo: dict[str, Float[np.ndarray, "3"]]
    highlight: dict[str, Radiance]


def decomposed(normals: Float[np.ndarray, "n 3"], shown: Mapping[str, Radiance]) -> Decomposed:
    """One photo; shown: radiance by material, at the same normals."""
    basis, image = harmonics(normals), np.stack(list(shown.values()))
    weight, albedo = np.ones(image.shape[:2]), np.median(image, axis=1)
    for _ in range(ITERATIONS):
        shading = np.stack([_shading(basis, image[..., c], albedo[:, c], weight) for c in range(3)], axis=-1)
        lit = np.maximum(basis @ shading, DARKEST)
        albedo = np.einsum("mn,mnc,nc->mc", weight, image, lit) / np.einsum("mn,nc->mc", weight, lit**2)
        residual = image - albedo[:, None] * lit
        weight = _weights(residual, image)
    highlight = dict(zip(shown, np.maximum(residual, 0), strict=True))
    return Decomposed(shading, dict(zip(shown, np.maximum(albedo, DARKEST), strict=True)), highlight)


def _shading(basis: np.ndarray, image: np.ndarray, albedo: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "9"]:
    """argmin Σ w (I − a Y·e)² of one channel."""
    of_pixel = np.einsum("mn,m->n", weight, albedo**2)
    return np.linalg.solve(
        (basis * of_pixel[:, None]).T @ basis, basis.T @ np.einsum("mn,m,mn->n", weight, albedo, image)
    )


def _weights(residual: Float[np.ndarray, "m n 3"], image: Float[np.ndarray, "m n 3"]) -> Float[np.ndarray, "m n"]:
    r = residual.mean(axis=-1)
    size = np.array([np.median(-row[row < 0]) if (row < 0).any() else 0.0 for row in r])
    scale = np.maximum(size, LEAST * image.mean(axis=(1, 2)))[:, None]
    return np.where(r > 0, 1 / (1 + (r / scale) ** 2), 1.0)


def averaged(photos: Mapping[int, Decomposed]) -> tuple[dict[str, np.ndarray], dict[int, np.ndarray]]:
    """exp α by material and exp β by photo, [3] each: a_mi ≈ exp(α_m + β_i)."""
    names, numbers = sorted({n for p in photos.values() for n in p.albedo}), list(photos)
    pairs = [(names.index(n), k) for k, p in enumerate(photos.values()) for n in p.albedo]
    known = np.log([photos[numbers[k]].albedo[names[m]] for m, k in pairs])
    design = np.zeros((len(pairs), len(names) + len(numbers)))
    for row, (m, k) in enumerate(pairs):
        design[row, [m, len(names) + k]] = 1
    found = np.exp(np.linalg.lstsq(design, known, rcond=None)[0])
    return dict(zip(names, found[: len(names)], strict=True)), dict(zip(numbers, found[len(names) :], strict=True))


class Intrinsic(msgspec.Struct, frozen=True):
    """Average albedos, each photo's shading, and highlights, which are carried as textures."""

    materials: dict[str, Reflectance]
    lights: dict[int, Map]
    shading: dict[int, Coefficients]
    photos: dict[int, Decomposed]
    texture: Texture
    lambertian: bool = True

    def new_view(self, material: str, light: int, seen: Seen) -> Radiance:
        """Average albedo, the photo's shading there, its highlight where the photo saw the point."""
        return self._shaded(material, self.shading[light], self.photos[light].highlight[material], seen)

    def new_light(self, material: str, light: Map, seen: Seen) -> Radiance:
        """Average albedo, shading of the new light, the mean highlight of the photos."""
        highlight = np.mean([p.highlight[material] for p in self.photos.values() if material in p.highlight], axis=0)
        return self._shaded(material, LAMBERT[:, None] * light_coefficients(light), highlight, seen)

    def new_material(self, material: Reflectance, light: int, seen: Seen) -> Radiance | None:
        """The light that the shading determines, of nine harmonics, reflected by the given material."""
        return Scene(self.lights[light], seen).of(material)

    def _shaded(self, material: str, shading: Coefficients, highlight: Radiance, seen: Seen) -> Radiance:
        lit = np.maximum(harmonics(seen.normals) @ shading, 0)
        return np.array(self.materials[material].diffuse) * lit + self.texture.at(seen, highlight, unseen=False)


def intrinsic(photos: Photos, truths: Mapping[str, Reflectance]) -> Intrinsic:
    """Decompose each photo, average.  truths: for the gauge alone, by their Lambertian parts, for only those does it state."""
    parts = {
        li: decomposed(photos.seen.normals, {n: v for (n, at), v in photos.radiance.items() if at == li})
        for li in photos.lights
    }
    albedo, scale = averaged(parts)
    found = {n: Reflectance(tuple(albedo[n].tolist()), (0.0,) * 3, 1.0) for n in photos.materials}
    factor = factor_of(found, lambertian_part(truths))
    shading = {li: part.shading * scale[li] / factor for li, part in parts.items()}
    found = {n: Reflectance(tuple((albedo[n] * factor).tolist()), (0.0,) * 3, 1.0) for n in found}
    return Intrinsic(found, {li: light_map(of) for li, of in shading.items()}, shading, parts, Texture(photos.seen))


def light_map(shading: Coefficients) -> Map:
    """The light of nine harmonics that shades so; what it has of negative light is cut."""
    return np.maximum(harmonics(lat_long_directions(ROWS, 2 * ROWS)) @ (shading / LAMBERT[:, None]), 0)
