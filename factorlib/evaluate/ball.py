"""Balls of a material in a measured light, by quadrature of its lat-long map, on which relighting is scored.

The ball is seen from the front, orthographically, in the light's frame (x right, y up, z toward the viewer).

The map is resampled to an equal-area octahedral square (Clarberg 2008, "Fast equal-area mapping of the (hemi)sphere
using SIMD") with a pyramid of averages over it.  All texels of a level have the same solid angle.  A sample that stands
for Ω steradians reads the level whose texels have Ω (filtered importance sampling, Křivánek and Colbert 2008).  The
samples are a fixed lattice, so there is no noise and results are reproducible byte for byte.

Diffuse   E(n)/π = (1/π) ∫ L(i) max(n·i, 0) di     sum over the texels of one level
Glossy    ∫ L(i) D G / (4 n·o) di                  a wide lobe (α > 0.2) by the same sum, a narrow one by sampling its
                                                   visible normals (Heitz 2018): with separable G = G1(i) G1(o) the
                                                   density cancels all but G1(i), so it is the mean of L(i) G1(n·i)
Mirror    L(2(n·o)n − o)                           averaged over the solid angle that a pixel of the ball covers
"""

from collections.abc import Callable
from functools import lru_cache, partial

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.results.materials import Reflectance

SIDE = 128  # side of the finest octahedral level; a texel is 1.6° across
WIDE_SIDE = 64  # side of the level that wide lobes are summed over
WIDE_ALPHA = 0.2  # α above which a lobe is wide
SAMPLES = 384  # samples of a narrow lobe
GOLDEN = (np.sqrt(5) - 1) / 2
VIEW = np.array([0.0, 0.0, 1.0])


class OctahedralLight(msgspec.Struct, frozen=True, eq=False):
    """Radiance averaged over octahedral texels, finest level first: [128, 128, 3], [64, 64, 3], …, [1, 1, 3]."""

    levels: tuple[Float[np.ndarray, "s s 3"], ...]

    @property
    def mean(self) -> Float[np.ndarray, "3"]:
        """Mean radiance over the sphere, RGB."""
        return self.levels[-1][0, 0]

    @property
    def texels(self) -> Float[np.ndarray, "t 3"]:
        """The texels of every level, row by row, finest level first."""
        return np.concatenate([level.reshape(-1, 3) for level in self.levels])

    @property
    def wide(self) -> Float[np.ndarray, "t 3"]:
        """The texels of the level `WIDE_SIDE` texels wide, row by row, each about 3° across."""
        return self.levels[(SIDE // WIDE_SIDE).bit_length() - 1].reshape(-1, 3)


Reflected = Callable[[OctahedralLight], Float[np.ndarray, "*n 3"]]  # maps a light to the radiance of points


def octahedral_light(radiance: Float[np.ndarray, "h w 3"]) -> OctahedralLight:
    """Return the pyramid of a lat-long map (layout of `factorlib.conventions`)."""
    # Repeat texels to at least 512 rows and 1024 columns, so that every octahedral texel receives several.
    times = max(1, -(-1024 // radiance.shape[1]), -(-512 // radiance.shape[0]))
    fine = np.repeat(np.repeat(np.asarray(radiance, np.float64), times, axis=0), times, axis=1)
    height, width = fine.shape[:2]
    # means over octahedral texels, weighted by solid angle
    area = np.repeat(lat_long_solid_angles(height, width), width)
    texel = _octahedral_texels(height, width)
    total = np.bincount(texel, area, SIDE * SIDE)
    sums = [np.bincount(texel, area * channel, SIDE * SIDE) for channel in fine.reshape(-1, 3).T]
    return OctahedralLight(
        _pyramid(np.stack([s / total for s in sums], axis=-1).reshape(SIDE, SIDE, 3).astype(np.float32))
    )


@lru_cache(maxsize=2)
def _octahedral_texels(height: int, width: int) -> Int[np.ndarray, " hw"]:
    """Return the index of the finest octahedral texel that contains each texel of a lat-long map."""
    return np.ravel_multi_index(_texel(lat_long_directions(height, width).reshape(-1, 3)), (SIDE, SIDE))


def uniform_light(colour: Float[np.ndarray, "3"]) -> OctahedralLight:
    """Return a light of the same radiance from every direction."""
    return OctahedralLight(_pyramid(np.broadcast_to(np.asarray(colour, np.float32), (SIDE, SIDE, 3))))


def texel_weights(
    direction: Float[np.ndarray, "n k 3"], solid_angle: Float[np.ndarray, "n k"], weight: Float[np.ndarray, "n k"]
) -> csr_array:
    """Return the matrix [n, t] of n weighted sums over a light's `texels`.

    Each of the k terms of a sum averages radiance over a solid angle about a direction, interpolated between the two
    nearest levels.

    Args:
        direction: unit directions
        solid_angle: solid angle of each term, steradians
        weight: weight of each term
    """
    # pyramid level whose texels have the solid angle, as a real number; `share` interpolates between two levels
    finest = 4 * np.pi / SIDE**2
    last = SIDE.bit_length() - 1
    level = np.clip(0.5 * np.log2(np.maximum(solid_angle, 1e-12) / finest), 0, last)
    below = np.minimum(level.astype(int), last - 1)
    row, column = _texel(direction)
    offsets = np.cumsum([0] + [(SIDE >> k) ** 2 for k in range(last + 1)])
    texels = [(offsets[k] + (row >> k) * (SIDE >> k) + (column >> k)).astype(np.int32) for k in (below, below + 1)]
    share = level - below  # weight of the coarser level
    terms = np.hstack([weight * (1 - share), weight * share])
    starts = np.arange(len(terms) + 1) * terms.shape[1]
    return csr_array(
        (terms.astype(np.float32).ravel(), np.hstack(texels).ravel(), starts), shape=(len(terms), offsets[-1])
    )


def diffuse_lobe(normals: Float[np.ndarray, "n 3"]) -> Reflected:
    """Return a function of a light: the radiance E(n)/π of a white Lambertian surface at each normal."""
    cosine = np.maximum(normals.astype(np.float32) @ octahedral_directions(WIDE_SIDE).T.astype(np.float32), 0)
    return partial(_integrate, cosine / np.float32(np.pi))


def glossy_lobe(normals: Float[np.ndarray, "n 3"], roughness: float) -> Reflected:
    """Return a function of a light: the radiance toward `VIEW` of GGX with k_s = 1 at each normal.

    The part that does not depend on the light, most of the work, is computed here.
    """
    alpha = max(float(roughness**2), 1e-3)
    return (_wide_lobe if alpha > WIDE_ALPHA else _narrow_lobe)(normals, alpha)


def _wide_lobe(normals: Float[np.ndarray, "n 3"], alpha: float) -> Reflected:
    # D G / (4 n·o) for each texel's direction
    directions = octahedral_directions(WIDE_SIDE)
    half = directions + VIEW
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-9)
    cos_o = np.maximum(normals @ VIEW, 1e-3).astype(np.float32)[:, None]
    cos_i, cos_h = (normals.astype(np.float32) @ d.T.astype(np.float32) for d in (directions, half))
    shadowing = _g1(np.maximum(cos_i, 1e-6), alpha) * _g1(cos_o, alpha)
    return partial(_integrate, np.where(cos_i > 0, _ggx(cos_h, alpha) * shadowing / (4 * cos_o), 0))


def _narrow_lobe(normals: Float[np.ndarray, "n 3"], alpha: float) -> Reflected:
    cos_o = np.clip(normals @ VIEW, 1e-3, 1.0).astype(np.float32)[:, None]
    half = _visible_normals(cos_o, alpha)
    view = np.concatenate([np.sqrt(1 - cos_o**2), np.zeros_like(cos_o), cos_o], axis=-1)[:, None, :]
    incoming = 2 * np.sum(view * half, axis=-1, keepdims=True) * half - view
    density = _g1(cos_o, alpha) * _ggx(half[..., 2], alpha) / (4 * cos_o)  # density of incoming directions, 1/sr
    # rows of the frame: tangent toward the viewer, bitangent, normal
    tangent = VIEW - normals[:, 2:] * normals
    facing = np.linalg.norm(tangent, axis=-1, keepdims=True) < 1e-6
    tangent = np.where(facing, np.array([1.0, 0.0, 0.0]), tangent)
    tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
    frame = np.stack([tangent, np.cross(normals, tangent), normals], axis=1).astype(np.float32)
    weight = np.where(incoming[..., 2] > 0, _g1(np.maximum(incoming[..., 2], 1e-6), alpha), 0.0)
    weights = texel_weights(incoming @ frame, 1 / (SAMPLES * density), weight / SAMPLES)
    return lambda light: weights @ light.texels


def mirror_ball(light: OctahedralLight, normals: Float[np.ndarray, "n 3"], size: int) -> Float[np.ndarray, "n 3"]:
    """Return the radiance of a perfect mirror ball.

    Args:
        light: the light
        normals: unit normals
        size: width of the ball in pixels; every pixel covers 16 / size² steradians of reflected directions
    """
    mirrored = 2 * normals[:, None, 2:] * normals[:, None] - VIEW
    weight = np.ones((len(normals), 1))
    return texel_weights(mirrored, 16 / size**2 * weight, weight) @ light.texels


def ball(light: OctahedralLight, material: Reflectance, normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the radiance of a ball in a light, with the BRDF k_d/π + k_s · D G / (4 (n·i)(n·o)).

    Args:
        light: the light
        material: the reflectance
        normals: unit normals
    """
    diffuse = np.asarray(material.diffuse, float)
    specular = np.asarray(material.specular, float)
    value = diffuse * diffuse_lobe(normals)(light)
    return value + specular * glossy_lobe(normals, material.roughness)(light) if specular.any() else value


def _integrate(response: Float[np.ndarray, "n t"], light: OctahedralLight) -> Float[np.ndarray, "n 3"]:
    """Return ∫ L · response over the texels of the level of `WIDE_SIDE`."""
    return response @ light.wide.astype(response.dtype) * (4 * np.pi / WIDE_SIDE**2)


def _g1(cosine: np.ndarray, alpha: float) -> np.ndarray:
    return 2 * cosine / (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2))


def _ggx(cos_h: np.ndarray, alpha: float) -> np.ndarray:
    return alpha**2 / (np.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)


def _visible_normals(cos_o: Float[np.ndarray, "n 1"], alpha: float) -> Float[np.ndarray, "n k 3"]:
    """Return half vectors distributed as the visible normals (Heitz 2018); the view lies in the local x–z plane."""
    # lattice on the unit disc
    k = np.arange(SAMPLES)
    radius, phi = (t.astype(np.float32) for t in (np.sqrt((k + 0.5) / SAMPLES), 2 * np.pi * ((k * GOLDEN) % 1)))
    # view in the stretched space, where the distribution is a hemisphere
    stretched = np.stack([alpha * np.sqrt(1 - cos_o**2), cos_o], axis=-1)
    sin, cos = np.moveaxis(stretched / np.linalg.norm(stretched, axis=-1, keepdims=True), -1, 0)
    across = np.broadcast_arrays(radius * np.cos(phi), cos_o)[0]
    along = radius * np.sin(phi)
    lift = 0.5 * (1 + cos)
    along = (1 - lift) * np.sqrt(1 - across**2) + lift * along
    up = np.sqrt(np.maximum(1 - across**2 - along**2, 0))
    # basis of the stretched view v = (sin, 0, cos): t1 = (0, 1, 0), t2 = v × t1 = (−cos, 0, sin)
    toward = alpha * (-cos * along + sin * up)
    upward = np.maximum(sin * along + cos * up, 1e-9)
    half = np.stack([toward, alpha * across, upward], axis=-1)
    return half / np.linalg.norm(half, axis=-1, keepdims=True)


def _pyramid(finest: Float[np.ndarray, "s s 3"]) -> tuple[np.ndarray, ...]:
    levels = [finest]
    while len(levels[-1]) > 1:
        s = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(s, 2, s, 2, 3).mean(axis=(1, 3)))
    return tuple(levels)


def _texel(direction: Float[np.ndarray, "*n 3"]) -> tuple[Int[np.ndarray, "*n"], Int[np.ndarray, "*n"]]:
    """Return row and column of unit directions on the finest equal-area octahedral square."""
    x, y, z = np.moveaxis(direction, -1, 0)
    radius = np.sqrt(np.maximum(1 - np.abs(z), 0))
    v = radius * np.arctan2(np.abs(y), np.abs(x)) * (2 / np.pi)
    u = radius - v
    u, v = np.where(z < 0, [1 - v, 1 - u], [u, v])  # the lower half is folded outward
    column = np.copysign(u, x)
    row = np.copysign(v, y)
    return tuple(np.clip(((t + 1) / 2 * SIDE).astype(int), 0, SIDE - 1) for t in (row, column))


def octahedral_directions(side: int) -> Float[np.ndarray, "t 3"]:
    """Return the directions of the octahedral texels' centres, row by row: the inverse of `_texel`."""
    centres = (np.arange(side) + 0.5) / side * 2 - 1
    v, u = (t.reshape(-1) for t in np.meshgrid(centres, centres, indexing="ij"))
    inside = 1 - np.abs(u) - np.abs(v)
    radius = 1 - np.abs(inside)
    near = np.where(inside >= 0, np.abs(v), 1 - np.abs(u))
    phi = np.pi / 2 * near / np.maximum(radius, 1e-12)
    z = np.copysign(1 - radius**2, inside)
    ring = radius * np.sqrt(np.maximum(2 - radius**2, 0))
    return np.stack([np.copysign(ring * np.cos(phi), u), np.copysign(ring * np.sin(phi), v), z], axis=-1)
