"""Methods of the comparison, as predictions of photos that were not taken.

Projective   Texturing: the photo's pixels are projected onto the sphere and rendered from the new view, which needs the
             sphere and the camera.  Points in the photo are interpolated by inverse distance between `BETWEEN` pixels;
             points outside it take the colour of the `NEAREST` ones.  A new light changes nothing: the colours
             are the mean of all photos of the material.
Intrinsic    A decomposition in the spirit of SIRFS (Barron and Malik 2015): albedo × shading + highlight, albedos
             averaged over photos.  Given are the normals and the labels; each photo is decomposed by itself.
   shading     S(n) = Σ e_lm Y_lm(n), nine spherical harmonics: what Lambert reflects of a distant light to within a few
               per cent (Ramamoorthi and Hanrahan 2001).  All objects of a photo share it.
   albedo      a, one a material and channel: in turn with e by weighted least squares of I − a S.
   highlight   max(I − a S, 0).  So that it does not pull at albedo and shading, a pixel's weight is 1 / (1 + (r/s)²)
               where its residual r is positive in the mean over channels, s the median size of those that are negative,
               or `LEAST` of the mean if that is more.
   average     a photo determines albedos but for a factor per channel: ln a_mi = α_m + β_i in least squares over photos
               i.  α is the answer, β goes into the photo's shading.
   new light   its own nine coefficients shade the albedo; the highlight stays on the surface as it is, the mean over
               photos.
Grey         Every material is the same grey Lambert, every light is even, of its photo's mean colour: the null.
Rendered     Reflectances and lights of a method that recovers both are rendered as the truth is.

Truths are handed to methods for the gauge alone: photos link all materials and all lights.
"""

from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.results.materials import Reflectance
from studies.errors import Materials, gauge_factor, in_gauge, scale_reflectance
from studies.spheres import Map, Photos, Radiance, SphereView

BETWEEN = 4  # pixels of the photo that a point is between
NEAREST = 12  # pixels that colour a point outside the photo
ALBEDO = 0.5  # of the grey ball
LAMBERT = np.array([1, *[2 / 3] * 3, *[1 / 4] * 5])  # A_l / π: what a white Lambert surface reflects of each harmonic
ITERATIONS = 60
LEAST = 0.01
DARKEST = 1e-4
ROWS = 32  # of the maps of lights that shading determines, and of even ones

Coefficients = Float[np.ndarray, "9 3"]


class Prediction(msgspec.Struct, frozen=True):
    """A method's answer.

    Attributes:
        materials: Reflectances that it states, by name, in the truth's gauge.
        lights: Maps that it states, by number, in that gauge.
        lambertian: True where it states no specular part.
        render: Radiance of a material in a light as a camera sees it: a photographed material by its name, or a new
            one; a photo's light by its number, or a new one; at most one of them is new.  None where the method has no
            answer.
    """

    materials: dict[str, Reflectance]
    lights: dict[int, Map]
    lambertian: bool
    render: Callable[[str | Reflectance, int | Map, SphereView], Radiance | None]


def lambertian_part(materials: Materials) -> dict[str, Reflectance]:
    """Remove specular parts."""
    return {name: Reflectance(m.diffuse, (0.0, 0.0, 0.0), m.roughness) for name, m in materials.items()}


def rendered(materials: dict[str, Reflectance], lights: dict[int, Map], lambertian: bool = False) -> Prediction:
    """Predict by the reflectance of each material and the map of each light."""

    def render(material: str | Reflectance, light: int | Map, view: SphereView) -> Radiance:
        material = materials[material] if isinstance(material, str) else material
        return view.render(material, lights[light] if isinstance(light, int) else light)

    return Prediction(materials, lights, lambertian, render)


def grey(photos: Photos, truths: Materials) -> Prediction:
    """Predict by the photos' mean colours."""
    ball = Reflectance((ALBEDO,) * 3, (0.0,) * 3, 1.0)
    lights = {}
    for li in photos.lights:
        colour = np.mean([values.mean(axis=0) for (_, k), values in photos.radiance.items() if k == li], axis=0)
        lights[li] = np.broadcast_to(colour / ALBEDO, (ROWS, 2 * ROWS, 3))
    return rendered(*in_gauge(dict.fromkeys(photos.materials, ball), lights, truths), lambertian=True)


# ── projective texturing ─────────────────────────────────────────────────────────────────────────────────────────────


class Texture:
    """Values at the points that a photo sees, to be rendered from other views."""

    def __init__(self, photo: SphereView):
        self._tree = cKDTree(photo.normals)
        self._least = photo.normals[:, 2].min()

    def render(self, view: SphereView, values: Radiance, fill: bool = True) -> Radiance:
        """Return the values of the photo's points at those of a view.

        fill: extrapolate to points that the photo does not see, else they are 0
        """
        visible = view.normals[:, 2] >= self._least
        colours = np.zeros((len(view.normals), 3))
        for points, count in ((visible, BETWEEN), (~visible & fill, NEAREST)):
            distance, index = self._tree.query(view.normals[points], count)
            weight = 1 / (distance + 1e-9)
            colours[points] = np.einsum("nk,nkc->nc", weight / weight.sum(axis=1, keepdims=True), values[index])
        return colours


def projective(photos: Photos, truths: Materials) -> Prediction:
    """Predict by the photos as textures; a texture knows no light apart from its material."""
    texture = Texture(photos.view)
    radiance = photos.radiance

    def render(material: str | Reflectance, light: int | Map, view: SphereView) -> Radiance | None:
        if isinstance(material, Reflectance):
            return None
        if isinstance(light, int):
            return texture.render(view, radiance[material, light])
        return texture.render(view, np.mean([v for (name, _), v in radiance.items() if name == material], axis=0))

    return Prediction({}, {}, False, render)


# ── intrinsic decomposition ──────────────────────────────────────────────────────────────────────────────────────────


def harmonics(directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 9"]:
    """Return the nine real, orthonormal spherical harmonics of degree 0, 1 and 2."""
    x, y, z = np.moveaxis(directions, -1, 0)
    one, two, three, four = np.sqrt(np.array([1, 3, 15, 5]) / (4 * np.pi))
    flat = [one * np.ones_like(x), two * y, two * z, two * x, three * x * y, three * y * z]
    return np.stack([*flat, four * (3 * z * z - 1) / 2, three * x * z, three * (x * x - y * y) / 2], axis=-1)


def light_coefficients(light: Map) -> Coefficients:
    """Return ∫ L Y over the sphere."""
    size = light.shape[:2]
    return np.einsum("h,hwk,hwc->kc", lat_long_solid_angles(*size), harmonics(lat_long_directions(*size)), light)


def light_of_shading(shading: Coefficients) -> Map:
    """Return the light of nine harmonics that shades so; what it has of negative light is cut."""
    return np.maximum(harmonics(lat_long_directions(ROWS, 2 * ROWS)) @ (shading / LAMBERT[:, None]), 0)


class Decomposition(msgspec.Struct, frozen=True):
    """Decomposed photo: shading's coefficients, each material's albedo, and highlights [n, 3].

    One factor per channel is free between shading and albedos.
    """

    shading: Coefficients
    albedo: dict[str, Float[np.ndarray, "3"]]
    highlight: dict[str, Radiance]


def decompose(normals: Float[np.ndarray, "n 3"], radiance: Mapping[str, Radiance]) -> Decomposition:
    """Decompose one photo; radiance: by material, at the same normals."""
    basis = harmonics(normals)
    image = np.stack(list(radiance.values()))
    weight = np.ones(image.shape[:2])
    albedo = np.median(image, axis=1)
    for _ in range(ITERATIONS):
        shading = np.stack([_shading(basis, image[..., c], albedo[:, c], weight) for c in range(3)], axis=-1)
        lit = np.maximum(basis @ shading, DARKEST)
        albedo = np.einsum("mn,mnc,nc->mc", weight, image, lit) / np.einsum("mn,nc->mc", weight, lit**2)
        residual = image - albedo[:, None] * lit
        r = residual.mean(axis=-1)
        size = np.array([np.median(-row[row < 0]) if (row < 0).any() else 0.0 for row in r])
        scale = np.maximum(size, LEAST * image.mean(axis=(1, 2)))[:, None]
        weight = np.where(r > 0, 1 / (1 + (r / scale) ** 2), 1.0)
    highlight = dict(zip(radiance, np.maximum(residual, 0), strict=True))
    return Decomposition(shading, dict(zip(radiance, np.maximum(albedo, DARKEST), strict=True)), highlight)


def _shading(basis: np.ndarray, image: np.ndarray, albedo: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "9"]:
    """Return argmin Σ w (I − a Y·e)² of one channel."""
    of_pixel = np.einsum("mn,m->n", weight, albedo**2)
    gram = (basis * of_pixel[:, None]).T @ basis
    return np.linalg.solve(gram, basis.T @ np.einsum("mn,m,mn->n", weight, albedo, image))


def average_albedos(photos: Mapping[int, Decomposition]) -> tuple[dict[str, np.ndarray], dict[int, np.ndarray]]:
    """Return exp α by material and exp β by photo, [3] each: a_mi ≈ exp(α_m + β_i)."""
    names = sorted({n for p in photos.values() for n in p.albedo})
    pairs = [(names.index(n), k) for k, p in enumerate(photos.values()) for n in p.albedo]
    albedos = np.log([albedo for p in photos.values() for albedo in p.albedo.values()])
    design = np.zeros((len(pairs), len(names) + len(photos)))
    for row, (m, k) in enumerate(pairs):
        design[row, [m, len(names) + k]] = 1
    parts = np.exp(np.linalg.lstsq(design, albedos, rcond=None)[0])
    return dict(zip(names, parts, strict=False)), dict(zip(photos, parts[len(names) :], strict=True))


def intrinsic(photos: Photos, truths: Materials) -> Prediction:
    """Decompose each photo, average.  Truths count by their Lambertian parts, for it states only those.

    New views have the average albedo, the photo's shading there, and its highlight, a texture, where the photo saw the
    point; new lights their own shading and the mean highlight of the photos; new materials the light that nine
    harmonics of shading determine.
    """
    normals = photos.view.normals
    radiance = photos.radiance
    texture = Texture(photos.view)
    parts = {li: decompose(normals, {n: v for (n, k), v in radiance.items() if k == li}) for li in photos.lights}
    albedo, scale = average_albedos(parts)
    relative = {n: Reflectance(tuple(albedo[n].tolist()), (0.0,) * 3, 1.0) for n in photos.materials}
    factor = gauge_factor(relative, lambertian_part(truths))
    shading = {li: part.shading * scale[li] / factor for li, part in parts.items()}
    materials = {n: scale_reflectance(m, factor) for n, m in relative.items()}
    lights = {li: light_of_shading(e) for li, e in shading.items()}

    def render(material: str | Reflectance, light: int | Map, view: SphereView) -> Radiance:
        if isinstance(material, Reflectance):
            return view.render(material, lights[light])
        if isinstance(light, int):
            coefficients = shading[light]
            highlight = parts[light].highlight[material]
        else:
            highlight = np.mean([p.highlight[material] for p in parts.values() if material in p.highlight], axis=0)
            coefficients = LAMBERT[:, None] * light_coefficients(light)
        lit = np.maximum(harmonics(view.normals) @ coefficients, 0)
        return np.array(materials[material].diffuse) * lit + texture.render(view, highlight, fill=False)

    return Prediction(materials, lights, True, render)
