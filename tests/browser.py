"""A browser for tests of pages, and what the report's viewer shows beside the same pixels by the reflection operator.

Error: |viewer − operator| / max over channels of the operator's.
"""

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
from factorlib.light.lobes import Lobes
from factorlib.reflection import reflection_operator
from factorlib.render.resynthesis import Reflector
from factorlib.results.materials import Reflectance

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
]  # fmt: skip
HALF_FIELD = np.radians(15)  # of the viewer's camera
BACK = 1.04 / np.sin(HALF_FIELD)  # its distance, in radii
EDGE = 2  # pixels inside the outline that are left out: there a pixel is filled in part
SIZE = 96
RADIANCE = """([object, photo, chosen, size]) => {
  const {renderer, data} = window.viewer;
  return Array.from(renderer.radiance({...chosen, object: renderer.objects.at(object), photo: data.photos.find((p) => p.name === photo)}, size));
}"""
START = {"azimuth": 0, "elevation": 0, "turn": 0, "zoom": 1, "sky": False, "stops": 0}


@cache
def started() -> Any:
    """One browser a process: Playwright allows no second."""
    from playwright.sync_api import sync_playwright

    playwright = sync_playwright().start()
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
    atexit.register(lambda: (browser.close(), playwright.stop()))
    return browser


@contextmanager
def opened(file: Path, **context) -> Iterator[tuple[Any, list[str]]]:
    """The page and a list that gathers what it complains of; context: what Playwright's `new_context` takes."""
    here = started().new_context(**context)
    page, complaints = here.new_page(), []
    page.on(
        "console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None
    )
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
    turned = light.rotate(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ YUP_FROM_CAMERA)
    return Reflector(reflection_operator("network"), turned)(material, normals, views)


def error(radiance: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """The error of each pixel."""
    return np.abs(radiance - true).max(axis=1) / np.maximum(true.max(axis=1), 1e-12)
