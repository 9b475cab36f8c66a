"""Answers of methods that take their time, in the comparison.

A step writes <case>/materials.json, a map for each light, and seconds.json.

Ours     The stage `solve`.
Mitsuba  Joint optimisation by differentiable rendering: Adam on the texels of a 16 × 32 `envmap` for each light, and on
         k_d, k_s and roughness of each material.  Materials are the blend of `diffuse` and `roughconductor` that this
         project exports, at weight one half.  Given are the sphere and its place, the camera, the pixels of each
         material, and that light does not bounce.  Its pictures are means of the photos over squares of pixels.
         Integrator `prb`, direct light alone, `SPP` samples a pixel in each pass, forward and backward with seeds of
         their own.  Loss: mean squared difference over the picture's peak, over all pairs; then one step of Adam.

Rate     The one of 0.003, 0.01, 0.03 and 0.1 that reached the lowest loss on a seed that is not reported.
End      The mean loss of the last `FLAT` steps is not 1 % below that of as many before.
Process  A process of its own with one thread: a process has one variant of Mitsuba, and sums are the same in every run.
"""

import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.inference.materials import ROUGHNESS
from factorlib.jsonfile import json_text, write_json
from factorlib.results.materials import Reflectance, read_materials
from factorlib.stage import Inputs, Progress
from factorlib.tracing.scene import MITSUBA_FROM_CAMERA, rgb, rigid, transform
from factorlib.tracing.variant import mitsuba
from studies.body import Photos, photographed
from studies.errors import Map, maps_of
from studies.spheres import materials_of, read_maps
from studies.steps import Params
from studies.steps.solve import solved
from studies.study import Comparison

log = logging.getLogger("factorlib.studies.answer")
ROWS = 16  # rows of an envmap
SPP = 16  # samples a pixel
FLAT = 60  # steps
RATE = 0.03  # of Adam
PEAK = 99.9  # percentile of a picture
AWAY = 5.0  # distance of the camera from the centre of the sphere
MAP_ROWS = 64  # rows of the maps that are written


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve, or optimise until the loss is flat; other methods take no time."""
    case = msgspec.convert(inputs.facts["dataset.case"], Comparison)
    home = out / inputs.photo
    home.mkdir()
    write_json(home / "seconds.json", 0)
    if case.method == "ours":
        _, tables = photographed(case, materials_of(case.seed), read_maps(inputs["worlds"], case.seed, case.lights))
        with TemporaryDirectory() as folder:
            seconds = solved(tables, case.solve, inputs, Path(folder), progress)
            table = read_materials(Path(folder) / "materials.json").materials
            written(home, {n: m.reflectance for n, m in table.items()}, maps_of(Path(folder), case.lights), seconds)
    if case.method == "mitsuba":
        words = [json_text(case), str(inputs["worlds"]), str(home)]
        subprocess.run([sys.executable, "-m", __spec__.name, *words], check=True)


def written(home: Path, materials: Mapping[str, Reflectance], lights: Mapping[int, Map], seconds: float) -> None:
    """Write an answer and the processor seconds that it took."""
    write_json(home / "materials.json", materials)
    write_json(home / "seconds.json", seconds)
    for light, texels in lights.items():
        write_rgb_exr(home / f"{light}.exr", texels.astype(np.float32), LAT_LONG)


class Joint:
    """Unknowns that all pairs of a material and a light share, and the scene of each pair.

    A scene is the sphere, seen by an orthographic camera.
    """

    def __init__(self, photos: Photos, pixels: int):
        self.mi = mitsuba()
        self.materials = photos.materials
        self.lights = photos.lights
        self.mask = _squares(photos.view.inside, pixels).all(axis=(1, 3))
        pictures = {pair: _squares(photos.view.picture(of), pixels) for pair, of in photos.radiance.items()}
        self.shown = {pair: of.mean(axis=(1, 3)).astype(np.float32) for pair, of in pictures.items()}
        self.scenes = {pair: self._scene(pixels) for pair in self.shown}
        self.parameters = {pair: self.mi.traverse(scene) for pair, scene in self.scenes.items()}
        self.integrator = self.mi.load_dict({"type": "prb", "max_depth": 2})

    def _scene(self, pixels: int) -> Any:
        film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        ahead = rigid(YUP_FROM_CAMERA, (0.0, 0.0, AWAY)) @ MITSUBA_FROM_CAMERA
        sampler = {"type": "independent"}
        gloss = {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "alpha": 0.16,
            "specular_reflectance": rgb(0.2),
        }
        matt = {"type": "diffuse", "reflectance": rgb(0.6)}
        return self.mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "prb", "max_depth": 2},
                "sensor": {"type": "orthographic", "to_world": transform(ahead), "sampler": sampler, "film": film},
                "ball": {
                    "type": "sphere",
                    "bsdf": {"type": "blendbsdf", "weight": 0.5, "bsdf_0": matt, "bsdf_1": gloss},
                },
                "light": {"type": "envmap", "bitmap": self.mi.Bitmap(np.ones((ROWS, 2 * ROWS, 3), np.float32))},
            }
        )

    def begin(self, rate: float = RATE) -> None:
        """Start from grey materials under even lights of the pictures' mean radiance."""
        mi = self.mi
        optimiser = self.mi.ad.Adam(lr=rate)
        columns = np.array(next(iter(self.parameters.values()))["light.data"]).shape[1]
        for light in self.lights:
            level = np.mean([of[self.mask].mean() for (_, at), of in self.shown.items() if at == light]) / 0.4
            optimiser[f"light {light}"] = mi.TensorXf(np.full((ROWS, columns, 3), level, np.float32))
        for name in self.materials:
            optimiser[f"diffuse {name}"] = mi.Color3f(0.3)
            optimiser[f"specular {name}"] = mi.Color3f(0.1)
            optimiser[f"roughness {name}"] = mi.Float(0.4)
        self.optimiser = optimiser

    def step(self, number: int) -> float:
        """Take one step of Adam within bounds, and return the mean loss of the pairs before it."""
        import drjit as dr

        losses = []
        mi = self.mi
        for k, (pair, parameters) in enumerate(self.parameters.items()):
            self.set(pair)
            seed = 2 * (number * len(self.parameters) + k)
            image = mi.render(
                self.scenes[pair],
                parameters,
                integrator=self.integrator,
                spp=SPP,
                spp_grad=SPP,
                seed=seed,
                seed_grad=seed + 1,
            )
            peak = float(np.percentile(self.shown[pair][self.mask], PEAK))
            scale = mi.TensorXf(np.repeat(self.mask[..., None], 3, 2).astype(np.float32) / peak)
            squares = dr.square((image - mi.TensorXf(self.shown[pair])) * scale)
            loss = dr.sum(squares, axis=None) / (3.0 * float(self.mask.sum()))
            dr.backward(loss / len(self.parameters))
            losses.append(float(np.array(loss).item()))
        self.optimiser.step()
        for name in self.optimiser.keys():  # noqa: SIM118
            bounds = {"roughness": ROUGHNESS, "light": (1e-4, 1e6)}.get(name.split()[0], (1e-4, 1.0))
            self.optimiser[name] = dr.clip(self.optimiser[name], *bounds)
        return float(np.mean(losses))

    def set(self, pair: tuple[str, int]) -> None:
        """Put the unknowns into a pair's scene."""
        material, light = pair
        parameters = self.parameters[pair]
        parameters["light.data"] = self.optimiser[f"light {light}"]
        parameters["ball.bsdf.bsdf_0.reflectance.value"] = 2 * self.optimiser[f"diffuse {material}"]
        parameters["ball.bsdf.bsdf_1.specular_reflectance.value"] = 2 * self.optimiser[f"specular {material}"]
        parameters["ball.bsdf.bsdf_1.alpha.value"] = self.optimiser[f"roughness {material}"] ** 2
        parameters.update()

    def material(self, name: str) -> Reflectance:
        """Return the current reflectance of a material."""
        unknowns = (self.optimiser[f"{kind} {name}"] for kind in ("diffuse", "specular", "roughness"))
        k_d, k_s, (rough,) = (np.array(value, float).reshape(-1).tolist() for value in unknowns)
        return Reflectance(tuple(k_d), tuple(k_s), rough)

    def light(self, number: int, rows: int = MAP_ROWS) -> Map:
        """Return the radiance at a map's texels, as Mitsuba itself interpolates it."""
        import drjit as dr

        pair = next(pair for pair in self.parameters if pair[1] == number)
        self.set(pair)
        directions = lat_long_directions(rows, 2 * rows).reshape(-1, 3)
        ray = dr.zeros(self.mi.SurfaceInteraction3f, len(directions))
        ray.wi = self.mi.Vector3f(*(self.mi.Float(np.ascontiguousarray(-k, np.float32)) for k in directions.T))
        return np.array(self.scenes[pair].environment().eval(ray)).T.reshape(rows, 2 * rows, 3)


def _squares(picture: np.ndarray, pixels: int) -> np.ndarray:
    times = len(picture) // pixels
    return picture.reshape(pixels, times, pixels, times, *picture.shape[2:])


def flat(losses: list[float]) -> bool:
    """Return whether the mean of the last `FLAT` losses is not 1 % below that of as many before.

    >>> flat([1.0] * 120), flat([1.0] * 119), flat([0.99**k for k in range(120)])
    (True, False, False)
    """
    return len(losses) >= 2 * FLAT and bool(np.mean(losses[-FLAT:]) > 0.99 * np.mean(losses[-2 * FLAT : -FLAT]))


def optimised(case: Comparison, photos: Photos) -> tuple[list[float], Joint]:
    """Return the losses of all steps and the last unknowns; in a process of its own."""
    one_thread_with_derivatives()
    joint = Joint(photos, case.pixels)
    losses = []
    joint.begin()
    while not flat(losses) and len(losses) < case.steps:
        losses.append(joint.step(len(losses)))
    return losses, joint


def one_thread_with_derivatives() -> None:
    """Choose the variant of Mitsuba that has derivatives, for this process.  Raises InputError where there is none."""
    os.environ.pop("FACTORLIB_MITSUBA", None)  # traced lights ask for the scalar variant, which has no derivatives
    if mitsuba().variant() != "llvm_ad_rgb":
        cure = "install LLVM 16 or later (Debian: apt-get install libllvm19), or name its library in DRJIT_LIBLLVM_PATH"
        raise InputError(
            "Mitsuba has no derivatives here: its joint optimisation needs LLVM",
            key="mitsuba",
            cure=cure,
        )
    import drjit

    drjit.set_thread_count(1)


def optimise(case: Comparison, worlds: Path, home: Path) -> None:
    """Photograph, optimise, and write the answer into the folder `home`."""
    photos, _ = photographed(case, materials_of(case.seed), read_maps(worlds, case.seed, case.lights))
    start = time.process_time()
    losses, joint = optimised(case, photos)
    seconds = round(time.process_time() - start, 3)
    if not flat(losses):
        log.warning(f"Mitsuba's optimisation was ended after {len(losses)} steps, before its loss was flat")
    written(
        home, {n: joint.material(n) for n in joint.materials}, {li: joint.light(li) for li in joint.lights}, seconds
    )


if __name__ == "__main__":
    try:
        optimise(msgspec.json.decode(sys.argv[1], type=Comparison), *map(Path, sys.argv[2:]))
    except InputError as error:
        sys.exit(f"error: {error}")
