"""The report's relighting viewer against the pipeline's own rendering: `make results ONLY=viewer`, of `build/eames`, in headless Chromium.

Error: balls of every material in every light, drawn in software, against the reflection operator on the same pixels,
|viewer − operator| / max over channels of the operator's.  Time: a frame while something moves, waiting for its last
pixel; the smallest and the median of several, for other programs only ever add to it.
"""

from __future__ import annotations

import atexit
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.light.lobes import Lobes
from factorlib.reflection import reflection_operator
from factorlib.render.reflect import Reflector
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import Reflectance, read_materials, reflectances
from studies.measured.tools import ROOT, Tables

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
]  # fmt: skip
HALF_FIELD = np.radians(15)  # of the viewer's camera
BACK = 1.04 / np.sin(HALF_FIELD)  # its distance, in radii
EDGE = 2  # pixels inside the outline that are left out: there a pixel is filled in part
SIZE, FRAMES = 96, 30
RADIANCE = """([object, photo, chosen, size]) => {
  const {renderer, data} = window.viewer;
  return Array.from(renderer.radiance({...chosen, object: renderer.objects.at(object), photo: data.photos.find((p) => p.name === photo)}, size));
}"""
START = {"azimuth": 0, "elevation": 0, "turn": 0, "zoom": 1, "sky": False, "stops": 0}


@cache
def _browser() -> Any:
    """One browser a process: Playwright allows no second."""
    from playwright.sync_api import sync_playwright

    playwright = sync_playwright().start()
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
    atexit.register(lambda: (browser.close(), playwright.stop()))
    return browser


@contextmanager
def opened(file: Path, **context) -> Iterator[tuple[Any, list[str]]]:
    """The page and a list that gathers what it complains of; context: what Playwright's `new_context` takes."""
    here = _browser().new_context(**context)
    page, complaints = here.new_page(), []
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda r: complaints.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
    page.set_default_timeout(120000)  # software draws slowly on a busy machine
    page.goto(file.resolve().as_uri())
    yield page, complaints
    here.close()


def shown(
    page: Any, index: int, material: str, photo: str, view: dict | None = None, size: int = SIZE
) -> Float[np.ndarray, "size size 4"]:
    """The viewer's finished picture, radiance and coverage, the uppermost row first.  index: of the object, −1 is the ball;  view: see START"""
    chosen = {**START, "materials": [material], **(view or {})}
    return np.array(page.evaluate(RADIANCE, [index, photo, chosen, size])).reshape(size, size, 4)[::-1]


def ball_seen(
    azimuth: float, elevation: float, size: int = SIZE
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, "size size"]]:
    """Normals and views (y-up) of the pixels inside the ball's outline, as the viewer's camera sees it, and those pixels."""
    back = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    right = np.cross([0, 1, 0], back) / np.hypot(back[0], back[2])
    x, y = np.meshgrid(*(((np.arange(size) + 0.5) / size * 2 - 1) * np.tan(HALF_FIELD) * sign for sign in (1, -1)))
    ray = x[..., None] * right + y[..., None] * np.cross(back, right) - back
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = -BACK * ray @ back
    under = along**2 - BACK**2 + 1
    inside = binary_erosion(under > 0, iterations=EDGE)
    hit = BACK * back + (along - np.sqrt(np.maximum(under, 0)))[..., None] * ray
    return hit[inside], -ray[inside], inside


def rendered(
    light: Lobes, material: Reflectance, normals: np.ndarray, views: np.ndarray, turn: float = 0.0
) -> Float[np.ndarray, "n 3"]:
    """The same by the reflection operator.  light: in a camera's frame;  turn: of the light about the upright axis, radians"""
    c, s = np.cos(turn), np.sin(turn)
    turned = light.turned(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ YUP_FROM_CAMERA)
    return Reflector(reflection_operator("network"), turned)(material, normals, views)


def error(radiance: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The error of each pixel."""
    return np.abs(radiance - true).max(axis=1) / np.maximum(true.max(axis=1), 1e-12)


def rows() -> Tables:
    """Errors by material, and times of a frame by its size.  InputError without the report or a browser."""
    build = ROOT / "build/eames"
    if CHROMIUM is None or not (build / "report/index.html").is_file():
        raise InputError(
            "no report, or no Chromium", file=build, cure="make all DATASET=eames; apt-get install chromium"
        )
    lights, (normals, views, inside) = read_lobes(build / "export/lobes.parquet"), ball_seen(0.0, 0.0)
    with opened(build / "report/index.html", viewport={"width": 1440, "height": 900}) as (page, _):
        photos = page.evaluate("viewer.data.photos.map((p) => [p.name, p.light])")
        page.evaluate("viewer.canvas.style.width = '64px'")
        errors, times = [], []
        for name, material in reflectances(read_materials(build / "export/materials.json")).items():
            pairs = (
                (shown(page, -1, name, p)[inside][:, :3], rendered(lights[light], material, normals, views))
                for p, light in photos
            )
            quantiles = np.percentile(np.concatenate([error(*pair) for pair in pairs]), [50, 95, 100])
            errors.append([name, f"{material.roughness:.2f}", *(f"{100 * e:.2f} %" for e in quantiles)])
        for size in (512, 256, 128):
            page.evaluate(f"viewer.seconds(3, {size})")
            seconds = page.evaluate(f"Array.from({{length: {FRAMES}}}, () => viewer.seconds(1, {size}))")
            times.append([f"{size}²", f"{1000 * min(seconds):.0f} ms", f"{1000 * np.median(seconds):.0f} ms"])
    return {
        "Error": [["material", "roughness", "median", "95th percentile", "worst"], *errors],
        f"A frame, of {FRAMES}": [["pixels", "smallest", "median"], *times],
    }
