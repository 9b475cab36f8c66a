"""Sets of m materials × i illuminations: each pair one sphere, traced by Mitsuba, with exact normals.

Sphere    fills a picture of 256² pixels, seen in perspective from six radii away; direct light alone.  Normals and views
          are those of the ray through a pixel's centre.  Pixels that the outline crosses, and those that see the surface at
          less than 8.6° (n·o < `GRAZING`), are left out: there the mean over a pixel is not the value at its centre.
Noise     samples are added in passes until the noise, from the difference of two halves of them, is `NOISE_DB` below
          the peak (the 99.9th percentile of the picture); what was reached is kept with the picture.
Light     made by `factorlib.generate.lights`, every third a clear sky, the others rooms; or lat-long maps of a folder,
          followed by made ones where there are too few.  Mean radiance 1.
Sets      smaller ones are corners of the largest: a pair is traced once and kept in build/bench/sets.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.generate import lights
from factorlib.geometry.camera import Camera
from factorlib.tracing.scene import Material, bsdf, envmap, light_seen, look, rigid, traced
from factorlib.urm.observations import Observations

SIZE, DISTANCE, GRAZING = 256, 6.0, 0.15
NOISE_DB, PASS_SPP, MOST_PASSES = 53.0, 64, 128
LIGHT_ROWS, LIGHT_SPP = 128, 64
PEAK = 99.9  # percentile of a picture
MATERIALS = {
    "brick": Material((0.5, 0.12, 0.1), (0.08, 0.08, 0.08), 0.6),
    "leaf": Material((0.1, 0.35, 0.14), (0.25, 0.25, 0.25), 0.35),
    "lacquer": Material((0.12, 0.16, 0.24), (0.4, 0.4, 0.4), 0.22),
    "chalk": Material((0.7, 0.68, 0.62), (0.04, 0.04, 0.04), 0.7),
    "gold": Material((0.15, 0.1, 0.04), (0.6, 0.45, 0.2), 0.3),
    "plum": Material((0.2, 0.06, 0.22), (0.12, 0.12, 0.12), 0.45),
    "sand": Material((0.45, 0.36, 0.22), (0.06, 0.06, 0.06), 0.5),
    "sea": Material((0.05, 0.25, 0.3), (0.3, 0.3, 0.3), 0.26),
    "soot": Material((0.05, 0.05, 0.05), (0.05, 0.05, 0.05), 0.4),
    "rose": Material((0.55, 0.25, 0.28), (0.15, 0.15, 0.15), 0.3),
}
SETS = {"3x3": (3, 3), "5x5": (5, 5), "1x5": (1, 5), "5x1": (5, 1), "10x10": (10, 10)}


class Pair(msgspec.Struct, frozen=True):
    """The picture of a material in a light: `radiance` [256, 256, 3], its noise in dB below the peak, and samples a pixel."""

    radiance: Float[np.ndarray, "h w 3"]
    noise_db: float
    spp: int

    @property
    def counted(self) -> Float[np.ndarray, "n 3"]:
        """The pixels that count, in rows."""
        return self.radiance[sphere()[2]]

    @property
    def peak(self) -> float:
        return float(np.percentile(self.counted, PEAK))


class SphereSet(msgspec.Struct, frozen=True):
    """pairs: (material, illumination) -> picture.  All of m × i are there."""

    name: str
    materials: dict[str, Material]
    illuminations: tuple[str, ...]
    pairs: dict[tuple[str, str], Pair]

    def observations(self, without: frozenset[tuple[str, str]] = frozenset()) -> Observations:
        """All pixels of all pairs but those held back, one photo an illumination."""
        normal, view, inside = sphere()
        y, x = np.nonzero(inside)
        shown = [(m, i) for i in self.illuminations for m in self.materials if (m, i) not in without]
        n, names = len(y), list(self.materials)
        photo = np.repeat([self.illuminations.index(i) for _, i in shown], n).astype("i4")
        radiance = np.concatenate([self.pairs[pair].radiance[inside] for pair in shown]).astype("f4")
        return Observations(
            normal=np.tile(normal, (len(shown), 1)).astype("f4"), view=np.tile(view, (len(shown), 1)).astype("f4"), radiance=radiance,
            clipped=np.zeros(radiance.shape, bool), material=np.repeat([names.index(m) for m, _ in shown], n).astype("i2"),
            photo=photo, illumination=photo, x=np.tile(x, len(shown)).astype("i4"), y=np.tile(y, len(shown)).astype("i4"),
            weight=np.ones(len(radiance), "f4"), materials=tuple(names), photos=self.illuminations, illuminations=self.illuminations,
        )  # fmt: skip

    def held_back(self) -> frozenset[tuple[str, str]]:
        """One pair of each material and illumination, for relighting; none where a material or light would be left alone."""
        names = list(self.materials)
        if min(len(names), len(self.illuminations)) < 3:
            return frozenset()
        return frozenset(zip(names, self.illuminations, strict=False))


def sphere_set(name: str, cache: Path, hdr: Path | None = None, say=print) -> SphereSet:
    """The set of that name, traced where it is not yet in `cache`; lights from the maps of the folder `hdr`."""
    if name not in SETS:
        raise InputError(f"no set '{name}'", cure=f"one of {', '.join(SETS)}")
    m, i = SETS[name]
    materials = dict(list(MATERIALS.items())[:m])
    illuminations = tuple(f"light_{k}" for k in range(i))
    folder = cache / (f"hdr_{_digest(*(p.name for p in map_files(hdr)))}" if hdr else "made")
    folder.mkdir(parents=True, exist_ok=True)
    pairs = {}
    for number, light in enumerate(illuminations):
        for k, (material_name, material) in enumerate(materials.items()):
            path = folder / f"{material_name}_{light}_{_digest(material, SIZE, DISTANCE, NOISE_DB)}.npz"
            if not path.exists():
                say(f"tracing {material_name} in {light}")
                _write(path, traced_pair(material, light_map(number, folder, hdr), seed=100 * number + k))
            pairs[material_name, light] = _read(path)
    return SphereSet(name, materials, illuminations, pairs)


def camera() -> Camera:
    """The picture's half width sees the sphere's outline, with two pixels to spare."""
    outline = np.tan(np.arcsin(1 / DISTANCE))
    return Camera(SIZE, SIZE, (SIZE / 2 - 2) / outline, (SIZE / 2, SIZE / 2))


@cache
def sphere(size: int = SIZE) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, "size size"]]:
    """Normals and views, camera frame, of the pixels that count, and which those are; unit sphere at (0, 0, DISTANCE)."""
    focal = camera().focal * size / SIZE
    at = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(at, at)
    ray = np.stack([x, y, np.full_like(x, focal)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = DISTANCE * ray[..., 2]
    depth2 = along**2 - DISTANCE**2 + 1
    normal = ray * (along - np.sqrt(np.maximum(depth2, 0)))[..., None] - [0, 0, DISTANCE]
    inside = (depth2 > 0) & (-(normal * ray).sum(-1) > GRAZING)
    return normal[inside], -ray[inside], inside


def traced_pair(material: Material, lat_long: Float[np.ndarray, "h w 3"], seed: int) -> Pair:
    """Passes are added in turn to two halves, whose difference tells the noise of their mean."""
    ball = {"type": "sphere", "center": [0, 0, -DISTANCE], "bsdf": bsdf(material)}
    world, light = rigid(YUP_FROM_CAMERA, np.zeros(3)), envmap(lat_long)
    halves, inside = np.zeros((2, SIZE, SIZE, 3)), sphere()[2]
    for number in range(MOST_PASSES):
        scene = {"ball": ball, "light": light}
        halves[number % 2] += traced(scene, camera(), world, PASS_SPP, MOST_PASSES * seed + number, max_depth=2)
        if number % 2:
            passes = number + 1
            mean, difference = halves.sum(0) / passes, (halves[0] - halves[1]) / passes
            noise = 20 * np.log10(np.percentile(mean[inside], PEAK) / np.sqrt(np.mean(difference[inside] ** 2)))
            if noise >= NOISE_DB:
                break
    return Pair(mean.astype("f4"), float(noise), passes * PASS_SPP)


def light_map(number: int, folder: Path, hdr: Path | None = None) -> Float[np.ndarray, "h w 3"]:
    """Illumination `number` in the camera's y-up frame, mean radiance 1; kept in `folder`."""
    path = folder / f"light_{number}_{LIGHT_ROWS}.npy"
    if not path.exists():
        maps = map_files(hdr)
        found = lights.captured(maps[number], LIGHT_ROWS) if number < len(maps) else made_light(number)
        np.save(path, (found / found.mean()).astype("f4"))
    return np.load(path)


def map_files(hdr: Path | None) -> list[Path]:
    return sorted(p for p in hdr.iterdir() if p.suffix in (".hdr", ".exr")) if hdr else []


def made_light(number: int) -> Float[np.ndarray, "h w 3"]:
    rng = np.random.default_rng(1000 + number)
    world_from_camera = look(rng.uniform(-14, -6), rng.uniform(0, 360))
    if number % 3:
        scene = lights.room(rng, windows=2, lamps=number % 3)
    else:
        forward = np.degrees(np.arctan2(world_from_camera[0, 2], world_from_camera[2, 2]))
        azimuth = forward + 180 + rng.choice([-1, 1]) * rng.uniform(35, 70)
        scene = lights.daylight(rng, rng.uniform(30, 50), azimuth, rows=2 * LIGHT_ROWS)
    return light_seen(scene, rigid(world_from_camera @ YUP_FROM_CAMERA, (0, 0, 0)), LIGHT_ROWS, LIGHT_SPP, 1000 + number)


def _digest(*parts) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:10]


def _write(path: Path, pair: Pair) -> None:
    whole = path.with_suffix(".part")
    with whole.open("wb") as file:
        np.savez(file, radiance=pair.radiance, noise_db=pair.noise_db, spp=pair.spp)
    whole.rename(path)


def _read(path: Path) -> Pair:
    with np.load(path) as data:
        return Pair(data["radiance"], float(data["noise_db"]), int(data["spp"]))
