"""Mitsuba's joint optimisation of the same photos, on the cases that are its own: writes <case>/optimised.json, and <case>/method.json for all.

Adam on texels of lights and numbers of materials (`studies.steps.adam`, which has unknowns, loss and sampling).  It knows the
body's mesh and place, the camera, which pixels are of which material, and that there is no light that bounces.  Its pictures are means of
the photos over squares of pixels.  The seconds that it took are a result of this study; they differ from run to run.

Rate     `RATE`, the one that reached the lowest loss on a seed that is not reported: `python -m studies.catalogue.comparison`.
End      flat: the mean loss of the last `FLAT` steps is not 1 % below that of as many before.
Process  its own, for the variant of Mitsuba is the process' own affair, with one thread, so that sums are the same in every run.
"""

from __future__ import annotations

import logging
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
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.errors import InputError
from factorlib.jsonfile import write_json
from factorlib.meshes.ply import write_ply
from factorlib.results.materials import Reflectance
from factorlib.stage import Inputs, Progress
from factorlib.tracing.scene import MITSUBA_FROM_CAMERA, rgb, rigid, transform
from factorlib.tracing.variant import mitsuba
from studies.body import REACH, Map, Photos, View, mesh, read_photos
from studies.steps import Params
from studies.steps.adam import FLAT, ROWS, Joint
from studies.study import Comparison, light_name

log = logging.getLogger("factorlib.studies.optimise")
RATE = 0.03
PEAK = 99.9  # percentile of a picture
AWAY = 5.0  # of the camera from the body's middle
MAP_ROWS = 64  # of the lights that are written


class Optimised(msgspec.Struct, frozen=True):
    """Where Adam ended.

    losses: of each step, mean squared difference over the peak's square;  flat: whether it ended for that, not for the number of steps
    processor: seconds, of all threads;  materials by name, lights by number, as lists
    """

    losses: list[float]
    flat: bool
    processor: float
    materials: dict[str, Reflectance]
    lights: dict[int, list]


class Picture(msgspec.Struct, frozen=True):
    """A picture and the radiance that its errors are divided by."""

    radiance: Float[np.ndarray, "h w 3"]
    peak: float


class Pictures(msgspec.Struct, frozen=True):
    """What the benchmark's class asks of a set: (material, light) -> picture, and their names."""

    materials: tuple[str, ...]
    illuminations: tuple[str, ...]
    pairs: dict[tuple[str, str], Picture]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Optimise until it is flat; for other methods, write only their name."""
    facts, home = inputs.facts["dataset.case"], out / inputs.photo
    case = msgspec.convert(facts, Comparison)
    home.mkdir()
    write_json(home / "method.json", case.method)
    if case.method == "mitsuba":
        end = optimised(case, read_photos(case, inputs["observe"] / inputs.photo))
        if not end.flat:
            log.warning(f"Mitsuba's optimisation was ended after {len(end.losses)} steps, before its loss was flat")
        write_json(home / "optimised.json", end)


class Bodies(Joint):
    """The benchmark's optimisation, of the body in place of its spheres, seen by an orthographic camera."""

    def __init__(self, seed: int, photos: Photos, pixels: int, folder: Path):
        self.mi, self.mesh = mitsuba(), folder / "body.ply"
        write_ply(self.mesh, mesh(seed))
        self.mask = _squares(photos.view.inside, pixels).all(axis=(1, 3))
        self.spheres = self._pictures(photos, pixels)
        self.scenes = {pair: self._scene(pixels) for pair in self.spheres.pairs}
        self.parameters = {pair: self.mi.traverse(scene) for pair, scene in self.scenes.items()}
        self.shown = {pair: picture.radiance for pair, picture in self.spheres.pairs.items()}
        self.integrator = self.mi.load_dict({"type": "prb", "max_depth": 2})

    def _pictures(self, photos: Photos, pixels: int) -> Pictures:
        pairs = {}
        for (material, light), radiance in photos.radiance.items():
            small = _squares(photos.view.picture(radiance), pixels).mean(axis=(1, 3)).astype(np.float32)
            pairs[material, light_name(light)] = Picture(small, float(np.percentile(small[self.mask], PEAK)))
        return Pictures(tuple(photos.materials), tuple(light_name(li) for li in photos.lights), pairs)

    def _scene(self, pixels: int) -> Any:
        gloss = {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "alpha": 0.16,
            "specular_reflectance": rgb(0.2),
        }
        matt = {"type": "diffuse", "reflectance": rgb(0.6)}
        film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        ahead = rigid(YUP_FROM_CAMERA, (0.0, 0.0, AWAY)) @ MITSUBA_FROM_CAMERA @ np.diag([REACH, REACH, 1.0, 1.0])
        sensor = {
            "type": "orthographic",
            "to_world": transform(ahead),
            "sampler": {"type": "independent"},
            "film": film,
        }
        return self.mi.load_dict({
            "type": "scene", "integrator": {"type": "prb", "max_depth": 2}, "sensor": sensor,
            "ball": {"type": "ply", "filename": str(self.mesh), "bsdf": {"type": "blendbsdf", "weight": 0.5, "bsdf_0": matt, "bsdf_1": gloss}},
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


def _squares(picture: np.ndarray, pixels: int) -> np.ndarray:
    times = len(picture) // pixels
    return picture.reshape(pixels, times, pixels, times, *picture.shape[2:])


def flat(losses: list[float]) -> bool:
    """Whether the last `FLAT` losses are on average not 1 % below as many before.

    >>> flat([1.0] * 120), flat([1.0] * 119), flat([0.99**k for k in range(120)])
    (True, False, False)
    """
    return len(losses) >= 2 * FLAT and bool(np.mean(losses[-FLAT:]) > 0.99 * np.mean(losses[-2 * FLAT : -FLAT]))


def optimised(case: Comparison, photos: Photos, rate: float = RATE) -> Optimised:
    """Optimise in a process of its own.  InputError where Mitsuba has no derivatives on this machine."""
    context, parent = get_context("spawn"), (os.getpid(),)
    with ProcessPoolExecutor(1, mp_context=context, initializer=_end_with, initargs=parent) as pool:
        return pool.submit(_optimised, case, photos.view, photos.radiance, rate).result()


def _end_with(parent: int) -> None:
    """End this process soon after its parent: nobody waits for an optimisation whose step was killed."""

    def watch() -> None:
        """Look twice a second."""
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _optimised(case: Comparison, view: View, radiance: Mapping, rate: float) -> Optimised:
    one_thread_with_derivatives()
    with TemporaryDirectory() as folder:
        joint, losses = Bodies(case.seed, Photos(view, dict(radiance)), case.pixels, Path(folder)), []
        start = time.process_time()
        joint.begin(rate)
        while not flat(losses) and len(losses) < case.steps:
            losses.append(float(np.mean(joint.step(len(losses)))))
        seconds, found = round(time.process_time() - start, 3), joint.materials()
        numbers = zip(joint.spheres.materials, found.diffuse, found.specular, found.roughness, strict=True)
        materials = {n: Reflectance(tuple(d.tolist()), tuple(s.tolist()), float(r)) for n, d, s, r in numbers}
        lights = {li: joint.light(light_name(li), MAP_ROWS).tolist() for li in case.lights}
    return Optimised(losses, flat(losses), seconds, materials, lights)


def one_thread_with_derivatives() -> None:
    """Make this process' Mitsuba the variant that has derivatives.  InputError where there is none."""
    os.environ.pop("FACTORLIB_MITSUBA", None)  # traced lights ask for the scalar variant, which has no derivatives
    if mitsuba().variant() != "llvm_ad_rgb":
        raise InputError(
            "Mitsuba has no derivatives here: its joint optimisation needs LLVM", key="mitsuba",
            cure="install LLVM 16 or later (Debian: apt-get install libllvm19), or name its library in DRJIT_LIBLLVM_PATH",
        )  # fmt: skip
    import drjit

    drjit.set_thread_count(1)
