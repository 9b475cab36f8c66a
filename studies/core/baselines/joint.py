"""Mitsuba's joint optimisation (`studies.core.baselines.adam`) of the same photos: Adam on texels of lights and numbers of materials.

It knows the body's mesh and place, the camera, which pixels are of which material, and that there is no light that bounces.
Unknowns, loss and sampling are the benchmark's; here the scene is the body, seen by an orthographic camera, its pictures
means of the photos over squares of pixels.

Rate     `RATE`, the one of `RATES` that reached the lowest loss on a seed that is not reported: `python -m studies.joint_rate`.
End      flat: the mean loss of the last `FLAT` steps is not 1 % below that of as many before.
Process  its own, for the variant of Mitsuba is the process' own affair, with one thread, so that sums are the same in every run.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.tools import Clock
from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.errors import InputError
from factorlib.meshes.ply import write_ply
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import MITSUBA_FROM_CAMERA, rgb, rigid, transform
from factorlib.tracing.variant import mitsuba
from studies.core.baselines import body, case
from studies.core.baselines.adam import FLAT, ROWS, Joint
from studies.core.baselines.photos import Photos
from studies.core.baselines.scene import Map
from studies.core.case import light_name

RATES = (0.003, 0.01, 0.03, 0.1)
RATE = 0.03
PEAK = 99.9  # percentile of a picture
AWAY = 5.0  # of the camera from the body's middle
MAP_ROWS = 64  # of the lights that are written


class Optimised(msgspec.Struct, frozen=True):
    """Where Adam ended.

    losses: of each step, mean squared difference over the peak's square;  flat: whether it ended for that, not for the number of steps
    processor: seconds, of all threads;  materials by name, lights by number, as lists
    """

    rate: float
    losses: list[float]
    flat: bool
    processor: float
    materials: dict[str, Reflectance]
    lights: dict[int, list]


class Shown(msgspec.Struct, frozen=True):
    """A picture and the radiance that its errors are divided by."""

    radiance: Float[np.ndarray, "h w 3"]
    peak: float


class Pictures(msgspec.Struct, frozen=True):
    """What the benchmark's class asks of a set: (material, light) -> picture, and their names."""

    materials: tuple[str, ...]
    illuminations: tuple[str, ...]
    pairs: dict[tuple[str, str], Shown]


class Bodies(Joint):
    """The benchmark's optimisation, of the body in place of its spheres."""

    def __init__(self, seed: int, photos: Photos, pixels: int, folder: Path):
        self.mi, self.mesh, self.small = mitsuba(), folder / "body.ply", pixels
        write_ply(self.mesh, body.mesh(seed))
        self.mask = _all_of(photos.seen.inside, pixels)
        self.spheres = _pictures(photos, pixels, self.mask)
        self.scenes = {pair: self._scene(pixels) for pair in self.spheres.pairs}
        self.parameters = {pair: self.mi.traverse(scene) for pair, scene in self.scenes.items()}
        self.shown = {pair: shown.radiance for pair, shown in self.spheres.pairs.items()}
        self.integrator = self.mi.load_dict({"type": "prb", "max_depth": 2})

    def _scene(self, seen_by: int) -> Any:
        gloss = {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "alpha": 0.16,
            "specular_reflectance": rgb(0.2),
        }
        look = {
            "type": "blendbsdf",
            "weight": 0.5,
            "bsdf_0": {"type": "diffuse", "reflectance": rgb(0.6)},
            "bsdf_1": gloss,
        }
        return self.mi.load_dict({
            "type": "scene", "integrator": {"type": "prb", "max_depth": 2}, "sensor": sensor(seen_by),
            "ball": {"type": "ply", "filename": str(self.mesh), "bsdf": look},
            "light": {"type": "envmap", "bitmap": self.mi.Bitmap(np.ones((ROWS, 2 * ROWS, 3), np.float32))},
        })  # fmt: skip

    def light(self, name: str, rows: int) -> Map:
        """What arrives from the directions of a map's texels, as Mitsuba itself interpolates it."""
        import drjit as dr

        pair = next(pair for pair in self.parameters if pair[1] == name)
        self._set(self.parameters[pair], pair)
        directions = lat_long_directions(rows, 2 * rows).reshape(-1, 3)
        ray = dr.zeros(self.mi.SurfaceInteraction3f, len(directions))
        ray.wi = self.mi.Vector3f(*(self.mi.Float(np.ascontiguousarray(-k, np.float32)) for k in directions.T))
        return np.array(self.scenes[pair].environment().eval(ray)).T.reshape(rows, 2 * rows, 3)


def sensor(pixels: int) -> dict[str, Any]:
    """The photos' camera: far in front, `body.REACH` to either side."""
    world_from_camera = (
        rigid(YUP_FROM_CAMERA, (0.0, 0.0, AWAY)) @ MITSUBA_FROM_CAMERA @ np.diag([body.REACH, body.REACH, 1.0, 1.0])
    )
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {
        "type": "orthographic",
        "to_world": transform(world_from_camera),
        "sampler": {"type": "independent"},
        "film": film,
    }


def _pictures(photos: Photos, pixels: int, mask: Bool[np.ndarray, "h w"]) -> Pictures:
    names, lights = tuple(photos.materials), tuple(light_name(li) for li in photos.lights)
    pairs = {}
    for (material, light), radiance in photos.radiance.items():
        small = _squares(photos.seen.picture(radiance), pixels).mean(axis=(1, 3)).astype(np.float32)
        pairs[material, light_name(light)] = Shown(small, float(np.percentile(small[mask], PEAK)))
    return Pictures(names, lights, pairs)


def _squares(picture: np.ndarray, pixels: int) -> np.ndarray:
    times = len(picture) // pixels
    return picture.reshape(pixels, times, pixels, times, *picture.shape[2:])


def _all_of(inside: Bool[np.ndarray, "H W"], pixels: int) -> Bool[np.ndarray, "h w"]:
    return _squares(inside, pixels).all(axis=(1, 3))


def flat(losses: list[float]) -> bool:
    """Whether the last `FLAT` losses are on average not 1 % below as many before.

    >>> flat([1.0] * 120), flat([1.0] * 119), flat([0.99**k for k in range(120)])
    (True, False, False)
    """
    return len(losses) >= 2 * FLAT and bool(np.mean(losses[-FLAT:]) > 0.99 * np.mean(losses[-2 * FLAT : -FLAT]))


def optimised(seed: int, photos: Photos, how: case.Joint, rate: float = RATE) -> Optimised:
    """Optimise in a process of its own.  InputError where Mitsuba has no derivatives on this machine."""
    with ProcessPoolExecutor(
        1, mp_context=get_context("spawn"), initializer=_end_with, initargs=(os.getpid(),)
    ) as pool:
        return pool.submit(_optimised, seed, photos.seen, photos.radiance, how, rate).result()


def _end_with(parent: int) -> None:
    """Nobody waits for an optimisation whose step was killed."""

    def watch() -> None:
        """Looks twice a second."""
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _optimised(seed: int, seen: body.Seen, radiance: Mapping, how: case.Joint, rate: float) -> Optimised:
    _one_thread_with_derivatives()
    with TemporaryDirectory() as folder:
        joint, clock, losses = Bodies(seed, Photos(seen, dict(radiance)), how.pixels, Path(folder)), Clock(), []
        joint.begin(rate)
        while not flat(losses) and len(losses) < how.steps:
            losses.append(float(np.mean(joint.step(len(losses)))))
        taken, found = clock.taken().processor, joint.materials()
        numbers = zip(joint.spheres.materials, found.diffuse, found.specular, found.roughness, strict=True)
        materials = {n: Reflectance(tuple(d.tolist()), tuple(s.tolist()), float(r)) for n, d, s, r in numbers}
        lights = {li: joint.light(light_name(li), MAP_ROWS).tolist() for li in sorted({li for _, li in radiance})}
    return Optimised(rate, losses, flat(losses), taken, materials, lights)


def _one_thread_with_derivatives() -> None:
    os.environ.pop("FACTORLIB_MITSUBA", None)  # traced lights ask for the scalar variant, which has no derivatives
    if mitsuba().variant() != "llvm_ad_rgb":
        raise InputError(
            "Mitsuba has no derivatives here: its joint optimisation needs LLVM", key="mitsuba",
            cure="install LLVM 16 or later (Debian: apt-get install libllvm19), or name its library in DRJIT_LIBLLVM_PATH",
        )  # fmt: skip
    import drjit

    drjit.set_thread_count(1)
