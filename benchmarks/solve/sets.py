"""Sets of m materials in i lights: each pair a photo of one sphere, traced by Mitsuba in direct light, normals exact.

A set is kept in build/bench/sets, by all that it was made from, and made once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.align.camera import Camera
from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.generate import lights
from factorlib.generate.tracing import Material, bsdf, envmap, look, rigid, traced
from factorlib.jsonfile import json_text
from factorlib.urm.observations import Observations

FOLDER = Path("build/bench/sets")
DISTANCE, GRAZING = 5.0, 0.05
LIGHT_ROWS, LIGHT_SPP = 128, 48


class Spheres(msgspec.Struct, frozen=True):
    """materials × lights photos of `size`² pixels; hdr: captured maps in place of made ones."""

    materials: int
    lights: int
    size: int = 256
    spp: int = 512
    seed: int = 0
    hdr: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.materials}x{self.lights}{' captured' if self.hdr else ''}"


class Truth(msgspec.Struct, frozen=True):
    diffuse: Float[np.ndarray, "m 3"]
    specular: Float[np.ndarray, "m 3"]
    roughness: Float[np.ndarray, "m"]


def drawn(spheres: Spheres) -> list[Material]:
    """Coloured materials from nearly matte to glossy, roughness .2 to .7."""
    rng = np.random.default_rng([1, spheres.seed])
    found = []
    for roughness in np.linspace(0.2, 0.7, spheres.materials) if spheres.materials > 1 else [0.35]:
        total, share = rng.uniform(0.45, 0.85), rng.uniform(0.15, 0.6)
        diffuse = total * (1 - share) * rng.uniform(0.3, 1, 3)
        found.append(Material(tuple(diffuse.round(4)), (round(total * share, 4),) * 3, round(float(roughness), 4)))
    return found


def truth_of(spheres: Spheres) -> Truth:
    found = drawn(spheres)
    return Truth(*(np.array([getattr(m, name) for m in found]) for name in ("diffuse", "specular", "roughness")))


def lights_of(spheres: Spheres) -> list[Float[np.ndarray, "h w 3"]]:
    """Lat-long maps of mean radiance one, in the camera's y-up frame: daylight and rooms in turn, or captured ones."""
    rng, maps = np.random.default_rng([2, spheres.seed]), []
    for k in range(spheres.lights):
        if spheres.hdr:
            light = lights.captured(Path(spheres.hdr[k % len(spheres.hdr)]), LIGHT_ROWS)
            light = np.roll(light, int(rng.integers(2 * LIGHT_ROWS)), axis=1)
        else:
            turn = look(rng.uniform(-14, -6), rng.uniform(0, 360))
            up = np.degrees(np.arctan2(turn[0, 2], turn[2, 2])) + 180
            things = (
                lights.room(rng, windows=2, lamps=1 + k % 2)
                if k % 2
                else lights.daylight(rng, rng.uniform(30, 50), up + rng.choice([-1, 1]) * 50)
            )
            light = lights.map_of(things, turn @ YUP_FROM_CAMERA, LIGHT_ROWS, LIGHT_SPP, int(rng.integers(1 << 24)))
        maps.append(light / light.mean())
    return maps


def sphere_seen(camera: Camera):
    """Where the sphere of radius 1 is seen, and there normal and direction to the viewer, camera frame."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    ray = np.stack([(x - camera.width / 2) / camera.focal, (y - camera.height / 2) / camera.focal, np.ones_like(x)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = DISTANCE * ray[..., 2]
    left = along**2 - DISTANCE**2 + 1
    normal = (along - np.sqrt(np.maximum(left, 0)))[..., None] * ray - [0, 0, DISTANCE]
    seen = (left > 0) & (-(normal * ray).sum(-1) > GRAZING)
    return seen, normal[seen], -ray[seen]


def observations_of(spheres: Spheres, progress=lambda done, total: None) -> Observations:
    """All pixels of all photos; photo k shows material k mod m in light k div m."""
    key = hashlib.sha256(json_text(spheres).encode() + Path(__file__).read_bytes()).hexdigest()[:16]
    path = FOLDER / f"{key}.npz"
    camera = Camera(spheres.size, spheres.size, spheres.size / 2 * np.sqrt(DISTANCE**2 - 1) * 0.97, (spheres.size / 2, spheres.size / 2))
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path.with_suffix(".draft.npz"), radiance=_traced(spheres, camera, progress))
        path.with_suffix(".draft.npz").rename(path)
    seen, normal, view = sphere_seen(camera)
    radiance = np.load(path)["radiance"][:, seen].astype(float)
    return observations(normal, view, radiance, spheres, np.argwhere(seen))


def observations(normal, view, radiance: Float[np.ndarray, "k n 3"], spheres: Spheres, place) -> Observations:
    photos, n = len(radiance), len(normal)
    index = np.repeat(np.arange(photos), n)
    return Observations(
        normal=np.tile(normal, (photos, 1)), view=np.tile(view, (photos, 1)), radiance=radiance.reshape(-1, 3),
        clipped=np.zeros((photos * n, 3), bool), material=(index % spheres.materials).astype("i2"), photo=index.astype("i4"),
        illumination=(index // spheres.materials).astype("i4"), x=np.tile(place[:, 1], photos).astype("i4"),
        y=np.tile(place[:, 0], photos).astype("i4"), weight=np.ones(photos * n, "f4"),
        materials=tuple(f"m{k:02d}" for k in range(spheres.materials)), photos=tuple(f"p{k:04d}" for k in range(photos)),
        illuminations=tuple(f"l{k:02d}" for k in range(spheres.lights)),
    )  # fmt: skip


def _traced(spheres: Spheres, camera: Camera, progress) -> Float[np.ndarray, "k h w 3"]:
    maps, found = lights_of(spheres), drawn(spheres)
    world, images = rigid(YUP_FROM_CAMERA, np.zeros(3)), []
    for light in maps:
        for material in found:
            progress(len(images), len(maps) * len(found))
            ball = {"type": "sphere", "center": [0.0, 0.0, -DISTANCE], "radius": 1.0, "bsdf": bsdf(material)}
            images.append(traced({"thing": ball, "light": envmap(light)}, camera, world, spheres.spp, len(images), max_depth=2))
    return np.array(images, np.float32)


def withheld(seen: Observations, pairs: Sequence[int]) -> Observations:
    """Without the photos of these numbers."""
    return seen.take(~np.isin(seen.photo, pairs))
