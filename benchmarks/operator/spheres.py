"""Spheres in a light of high dynamic range: by its texels, by lobes fitted to it, and by each operator from these lobes.

The light is a map that the project generated, with sky, sun and walls (`data/synthetic/truth`).  What separates the first
two rows is the lobes; what separates an operator's row from the second is the operator.

By quadrature   Wide reflections are sums over the map's texels.  Narrow ones (roughness below .3) are means over a lattice
                of GGX half vectors, whose density D(h) n·h / (4 o·h) leaves L(i) G1(n·i) G1(n·o) (o·h) / ((n·o)(n·h)), but
                for what is brighter than a bound (the sun), which is a sum over subdivided texels: so neither has noise.
Lobes           Fibonacci lattices of three widths, and sharp ones at the brightest texels; weights by non-negative least
                squares over the sphere.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_dilation

from benchmarks.figure import page, text
from benchmarks.operator.variants import fast_names, made
from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.evaluate.ball import ball_normals
from factorlib.images.exr import read_rgb_exr
from factorlib.images.photo import read_photo
from factorlib.images.picture import exposure_of, picture
from factorlib.images.transfer import srgb_encode
from factorlib.light.latlong import lat_long_of_lobes, sampled
from factorlib.light.lobes import Lobes
from factorlib.reflection.brdf import smith, specular
from factorlib.report.png import data_uri
from factorlib.solve.few_lobes.weights import nonnegative_minimum

LIGHT = Path(__file__).resolve().parents[2] / "data" / "synthetic" / "truth" / "garden_light.exr"
ROUGHNESS = (0.1, 0.2, 0.35, 0.6, 1.0)
DIFFUSE = "diffuse"
SIZE = 80  # pixels across a sphere
LATTICES = ((32, 7.0), (128, 28.0), (512, 115.0))  # lobes and their sharpness
SPOTS, SPOT_SHARPNESS = 32, (300.0, 1000.0, 2500.0)  # brightest texels that get lobes of their own, and their sharpness
BLOCKS = (1, 2, 4, 8, 16, 32)  # texels a side whose mean light the lobes are fitted to
HALF_VECTORS = 1024  # of a narrow reflection
SPLIT, FINER = 99.7, 8  # percentile of brightness beyond which texels are summed, and their subdivision
NARROW = 0.3  # roughness
VIEW = np.array([0.0, 0.0, 1.0])
LIFT = 30  # of differences

Balls = dict[str, Float[np.ndarray, "n 3"]]  # by material: radiance of the pixels of a sphere


class Spheres(msgspec.Struct, frozen=True):
    """light, lobe_light: lat-long maps;  rows: balls by what made them, "true light" and "light as lobes" first.

    scores: {row: {material: PSNR in dB}}, tone-mapped, of "light as lobes" against the truth, of operators against it.
    """

    light: Float[np.ndarray, "h w 3"]
    lobe_light: Float[np.ndarray, "h w 3"]
    lobes: int
    rows: dict[str, Balls]
    scores: dict[str, dict[str, float]]


TRUE, FITTED = "true light", "light as lobes"


def render(path: Path = LIGHT) -> Spheres:
    light = read_rgb_exr(path).astype(float) if path.suffix == ".exr" else read_photo(path, "linear").radiance.astype(float)
    light = averaged(light, 128)
    lobes = fitted_lobes(light)
    lobe_light = lat_long_of_lobes(lobes.turned(YUP_FROM_CAMERA), 256, 512)  # which it turns back
    normals, _ = ball_normals(SIZE)
    rows = {TRUE: balls_by_quadrature(light, normals), FITTED: balls_by_quadrature(lobe_light, normals)}
    rows |= {name: balls_by_operator(made(name, "float32"), lobes, normals) for name in fast_names()}
    scores = {}
    for name in list(rows)[1:]:
        against = rows[TRUE if name == FITTED else FITTED]
        scores[name] = {m: psnr(rows[name][m], against[m], exposure(rows, m)) for m in against}
    return Spheres(light, averaged(lobe_light, 128), len(lobes), rows, scores)


def averaged(light: Float[np.ndarray, "h w 3"], height: int) -> Float[np.ndarray, "_ _ 3"]:
    """Means of whole texels, so that at most `height` rows are left."""
    by = max(1, light.shape[0] // height)
    rows, columns = light.shape[0] // by, light.shape[1] // by
    return light[: rows * by, : columns * by].reshape(rows, by, columns, by, 3).mean((1, 3))


# lobes ----------------------------------------------------------------------------------------------------------------


def fibonacci(count: int) -> Float[np.ndarray, "count 3"]:
    """Directions spread evenly over the sphere."""
    k = np.arange(count) + 0.5
    y, phi = 1 - 2 * k / count, np.pi * (3 - np.sqrt(5)) * k
    s = np.sqrt(1 - y * y)
    return np.stack([s * np.cos(phi), y, s * np.sin(phi)], -1)


def fitted_lobes(light: Float[np.ndarray, "h w 3"]) -> Lobes:
    """The non-negative lobes of the dictionary nearest to the map, y-up as the map.

    Least squares over texels, and over the means of ever larger blocks of them, a block as heavy as the square of its
    side: these are what rough surfaces see, and the sun's texels would outweigh them.
    """
    directions = lat_long_directions(*light.shape[:2]).reshape(-1, 3)
    area = np.repeat(lat_long_solid_angles(*light.shape[:2]), light.shape[1])
    spots = directions[np.argsort(-light.max(-1).reshape(-1), kind="stable")[:SPOTS]]
    axis = np.concatenate([*(fibonacci(count) for count, _ in LATTICES), *[spots] * len(SPOT_SHARPNESS)])
    sharpness = np.concatenate([*(np.full(n, lam) for n, lam in LATTICES), *(np.full(SPOTS, lam) for lam in SPOT_SHARPNESS)])
    atoms = np.exp(sharpness * (directions @ axis.T - 1))
    gram, right = 0, 0
    for by in BLOCKS:
        made_of, target, size = (blocks(t * area[:, None], light.shape, by) for t in (atoms, light.reshape(-1, 3), np.ones((len(area), 1))))
        gram, right = gram + made_of.T @ (made_of * by**2 / size), right + made_of.T @ (target * by**2 / size)
    weight = np.stack([nonnegative_minimum(gram, right[:, c]) for c in range(3)], -1)
    kept = weight.max(1) > 0
    return Lobes(axis[kept], sharpness[kept], weight[kept])


def blocks(values: Float[np.ndarray, "k c"], shape: tuple[int, ...], by: int) -> Float[np.ndarray, "_ c"]:
    """Sums over blocks of by × by texels."""
    return values.reshape(shape[0] // by, by, shape[1] // by, by, -1).sum((1, 3)).reshape(-1, values.shape[1])


# balls ----------------------------------------------------------------------------------------------------------------


def balls_by_quadrature(light: Float[np.ndarray, "h w 3"], normals: Float[np.ndarray, "n 3"]) -> Balls:
    texels = texels_of(averaged(light, 128))
    found = {name_of(r): narrow(light, normals, r) if r < NARROW else summed(*texels, normals, r) for r in ROUGHNESS}
    return found | {DIFFUSE: summed(*texels, normals, None)}


def name_of(roughness: float) -> str:
    return f"roughness {roughness:g}"


def texels_of(light: Float[np.ndarray, "h w 3"], where=None, finer: int = 1) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Directions and power (radiance × steradian) of the texels `where` (all), each subdivided `finer` times a side, bilinear."""
    height, width = light.shape[:2]
    row, column = np.nonzero(np.ones((height, width), bool) if where is None else where)
    if finer == 1:
        return lat_long_directions(height, width)[row, column], light[row, column] * lat_long_solid_angles(height, width)[row, None]
    step = (np.arange(finer) + 0.5) / finer
    theta = np.pi * (row[:, None, None] + step[:, None]) / height + 0 * step
    phi = 2 * np.pi * (0.5 - (column[:, None, None] + step) / width) + 0 * theta
    sin = np.sin(theta)
    directions = np.stack([sin * np.sin(phi), np.cos(theta), sin * np.cos(phi)], -1).reshape(-1, 3)
    area = 2 * np.pi**2 / (height * width * finer**2) * sin.reshape(-1, 1)
    return directions, sampled(light, directions) * area


def summed(
    directions: Float[np.ndarray, "k 3"], power: Float[np.ndarray, "k 3"], normals: Float[np.ndarray, "n 3"], roughness: float | None
) -> Float[np.ndarray, "n 3"]:
    """Σ of power times f n·i, f of k_s = 1, or of k_d = 1 where roughness is None."""
    view, directions, power = (torch.from_numpy(np.asarray(t)).float() for t in (VIEW, directions, power))
    half = torch.nn.functional.normalize(directions + view, dim=1)
    result = []
    for n in torch.from_numpy(normals).float().split(128):
        ni, no = n @ directions.T, n @ view
        kernel = ni.clamp_min(0) / np.pi if roughness is None else specular(torch.tensor(roughness**2), ni, no[:, None], n @ half.T)
        result.append(kernel @ power)
    return torch.cat(result).double().numpy()


def narrow(light: Float[np.ndarray, "h w 3"], normals: Float[np.ndarray, "n 3"], roughness: float) -> Float[np.ndarray, "n 3"]:
    """By half vectors, but for the part of the light above the bound, which is summed."""
    excess = light * (1 - 1 / np.maximum(light.max(-1, keepdims=True) / np.percentile(light.max(-1), SPLIT), 1))
    touched = binary_dilation(excess.max(-1) > 0, np.ones((3, 3)))
    return by_half_vectors(light - excess, normals, roughness) + summed(*texels_of(excess, touched, FINER), normals, roughness)


def by_half_vectors(light: Float[np.ndarray, "h w 3"], normals: Float[np.ndarray, "n 3"], roughness: float) -> Float[np.ndarray, "n 3"]:
    """Mean over a lattice of half vectors of density D(h) n·h; the map is bilinear between its texels."""
    alpha, k = torch.tensor(roughness**2, dtype=torch.float64), np.arange(HALF_VECTORS) + 0.5
    u, phi = k / HALF_VECTORS, 2 * np.pi * (k * (np.sqrt(5) - 1) / 2 % 1)
    tan = float(alpha) * np.sqrt(u / (1 - u))
    nh = 1 / np.sqrt(1 + tan**2)
    local = np.stack([tan * nh * np.cos(phi), tan * nh * np.sin(phi), nh], -1)
    result = []
    for rows in np.array_split(normals, max(1, len(normals) // 256)):
        h = np.einsum("hk,nkc->nhc", local, frames(rows))
        oh, no = h @ VIEW, (rows @ VIEW)[:, None]
        i = 2 * oh[..., None] * h - VIEW
        ni = np.einsum("nhc,nc->nh", i, rows)
        shadowed = (smith(alpha, torch.from_numpy(ni)) * smith(alpha, torch.from_numpy(no))).numpy()
        share = np.where((oh > 0) & (ni > 0), shadowed * oh / (no * nh), 0)
        result.append(np.einsum("nh,nhc->nc", share, sampled(light, i)) / HALF_VECTORS)
    return np.concatenate(result)


def frames(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rows t, b, n of a right-handed frame about each normal."""
    aside = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    t = np.cross(aside, normals)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    return np.stack([t, np.cross(normals, t), normals], 1)


def balls_by_operator(operator, lobes: Lobes, normals: Float[np.ndarray, "n 3"]) -> Balls:
    n, axis, weight, view = (torch.as_tensor(t).to(operator.dtype) for t in (normals, lobes.axis, lobes.weight, VIEW))
    sharpness, oz = torch.as_tensor(lobes.sharpness).to(operator.dtype), (axis @ view)[None]

    def ball(reflected) -> Float[np.ndarray, "n 3"]:
        with torch.no_grad():
            return torch.cat([reflected(part, part @ axis.T) @ weight for part in n.split(128)]).double().numpy()

    def specular(roughness: float):
        alike = torch.tensor(roughness, dtype=operator.dtype)
        return lambda part, nz: operator.specular(alike, sharpness, part @ view, nz, oz.expand(nz.shape).contiguous())

    return {name_of(r): ball(specular(r)) for r in ROUGHNESS} | {DIFFUSE: ball(lambda part, nz: operator.diffuse(sharpness, nz))}


# how far apart --------------------------------------------------------------------------------------------------------


def exposure(rows: dict[str, Balls], material: str) -> float:
    """One for a material's whole column: the truth's 99th percentile becomes white."""
    return exposure_of(rows[TRUE][material])


def psnr(found: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"], exposed: float) -> float:
    """Of display values in [0, 1] (exposed, cut, sRGB-encoded) over the sphere's pixels, dB."""
    a, b = (srgb_encode(np.clip(t * exposed, 0, 1)) for t in (found, true))
    return round(float(-10 * np.log10(np.mean((a - b) ** 2))), 2)


def shown(values: Float[np.ndarray, "n 3"], exposed: float) -> UInt8[np.ndarray, "s s 3"]:
    """The sphere on white."""
    _, inside = ball_normals(SIZE)
    pixels = np.full((SIZE, SIZE, 3), 255, np.uint8)
    pixels[inside] = picture(values, exposed)
    return pixels


def difference(found: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"], exposed: float) -> UInt8[np.ndarray, "s s 3"]:
    """Signed, of display values, `LIFT` times, about grey: brighter than grey where too bright."""
    _, inside = ball_normals(SIZE)
    a, b = (srgb_encode(np.clip(t * exposed, 0, 1)) for t in (found, true))
    pixels = np.full((SIZE, SIZE, 3), 255, np.uint8)
    pixels[inside] = np.rint(255 * np.clip(0.5 + LIFT / 2 * (a - b), 0, 1)).astype(np.uint8)
    return pixels


def spheres_figure(spheres: Spheres) -> str:
    """Columns of materials; rows of what made them, an operator's followed by its difference from "light as lobes"."""
    materials, step, left, top = list(spheres.rows[TRUE]), SIZE + 8, 118, 132
    cells, words, y = [], [], 0
    for name, balls in spheres.rows.items():
        cells.append((y, [shown(balls[m], exposure(spheres.rows, m)) for m in materials]))
        words += _row_words(spheres, name, top + y, left, step)
        y += SIZE + (6 if name == TRUE else 20)
        if name not in (TRUE, FITTED):
            fitted = spheres.rows[FITTED]
            cells.append((y, [difference(balls[m], fitted[m], exposure(spheres.rows, m)) for m in materials]))
            words.append(text(left - 10, top + y + SIZE / 2 + 4, f"difference × {LIFT}", "end", "soft"))
            y += SIZE + 8
    canvas = np.full((y, len(materials) * step, 3), 255, np.uint8)
    for at, row in cells:
        for k, pixels in enumerate(row):
            canvas[at : at + SIZE, k * step : k * step + SIZE] = pixels
    words += [text(left + k * step + SIZE / 2, top - 8, m.removeprefix("roughness "), "middle") for k, m in enumerate(materials)]
    words.append(text(left - 10, top - 8, "roughness", "end"))
    return page(
        left + len(materials) * step + 8, top + y + 24, [*_head(spheres, left), image(left, top, canvas), *words, _foot(left, top + y + 12)]
    )


def _row_words(spheres: Spheres, name: str, y: float, left: float, step: float) -> list[str]:
    title = text(left - 10, y + SIZE / 2 + 4, name.replace("_", " "), "end")
    scores = spheres.scores.get(name, {}).values()
    return [title, *(text(left + k * step + SIZE / 2, y + SIZE + 12, f"{s:.1f} dB", "middle", "soft small") for k, s in enumerate(scores))]


def _head(spheres: Spheres, left: float) -> list[str]:
    exposed = exposure_of(spheres.light, percentile=95.0)
    maps = [picture(averaged(m, 64), exposed) for m in (spheres.light, spheres.lobe_light)]
    parts = [
        text(left - 10, 22 + 36, "the light", "end"),
        image(left, 22, maps[0]),
        text(left + 2 * 136 - 10, 22 + 36, f"{spheres.lobes} lobes", "end"),
    ]
    return [*parts, image(left + 2 * 136, 22, maps[1])]


def _foot(left: float, y: float) -> str:
    return text(left, y, "PSNR of display values: of the lobes against the true light, of operators against the lobes", css="soft small")


def image(x: float, y: float, pixels: UInt8[np.ndarray, "h w 3"]) -> str:
    height, width = pixels.shape[:2]
    return f'<image x="{x:g}" y="{y:g}" width="{width}" height="{height}" href="{data_uri(pixels)}"/>'
