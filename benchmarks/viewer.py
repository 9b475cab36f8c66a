"""The report's relighting viewer against the pipeline's own rendering: `make bench-viewer [DATASET=eames]`, from `build/<dataset>`.

Error: balls of every material in every light, drawn by headless Chromium in software, against the reflection operator on the same pixels,
|shown − rendered| / max over channels of the rendered.  Time: a frame while something moves (`QUICK` samples), waiting for its last pixel;
the smallest and the median of several, for other programs only ever add to it.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion

from benchmarks.browser import opened
from benchmarks.markdown import ROOT, refresh, table
from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.light.lobes import Lobes
from factorlib.reflection import reflection_operator
from factorlib.render.reflect import Reflector
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import Reflectance, read_materials, reflectances

HALF_FIELD = np.radians(15)  # of the viewer's camera
BACK = 1.04 / np.sin(HALF_FIELD)  # its distance, in radii
EDGE = 2  # pixels inside the outline that are left out: there a pixel is filled in part
SIZE, FRAMES = 96, 30
RADIANCE = """([mesh, photo, chosen, size]) => {
  const {renderer, data} = window.viewer;
  return Array.from(renderer.radiance({...chosen, mesh: renderer.meshes.at(mesh), photo: data.photos.find((p) => p.name === photo)}, size));
}"""
START = {"azimuth": 0, "elevation": 0, "turn": 0, "zoom": 1, "sky": False, "stops": 0}


def shown(
    page, mesh: int, material: str, photo: str, view: dict | None = None, size: int = SIZE
) -> Float[np.ndarray, "size size 4"]:
    """The viewer's finished picture, radiance and coverage, the uppermost row first.  mesh: −1 is the ball;  view: see START"""
    chosen = {**START, **(view or {}), "material": material}
    return np.array(page.evaluate(RADIANCE, [mesh, photo, chosen, size])).reshape(size, size, 4)[::-1]


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
    light: Lobes,
    material: Reflectance,
    normals: Float[np.ndarray, "n 3"],
    views: Float[np.ndarray, "n 3"],
    turn: float = 0.0,
) -> Float[np.ndarray, "n 3"]:
    """The same by the reflection operator.  light: in a camera's frame;  turn: of the light about the upright axis, radians"""
    c, s = np.cos(turn), np.sin(turn)
    turned = light.turned(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ YUP_FROM_CAMERA)
    return Reflector(reflection_operator("network"), turned, 0.0)(material, normals, views)


def error(found: Float[np.ndarray, "n 3"], wanted: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """By pixel."""
    return np.abs(found - wanted).max(axis=1) / np.maximum(wanted.max(axis=1), 1e-12)


def main(build: Path) -> None:
    """Print the two tables, and write them into docs/formats.md where they are of data/eames."""
    materials = reflectances(read_materials(build / "export/materials.json"))
    lights = read_lobes(build / "export/lobes.parquet")
    normals, views, inside = ball_seen(0.0, 0.0)
    with opened(build / "report/index.html", viewport={"width": 1440, "height": 900}) as (page, _):
        photos = {
            p["name"]: p["light"]
            for p in page.evaluate("viewer.data.photos.map((p) => ({name: p.name, light: p.light}))")
        }
        page.evaluate("viewer.canvas.style.width = '64px'")
        rows = []
        for material, reflectance in materials.items():
            errors = np.concatenate([
                error(shown(page, -1, material, photo)[inside][:, :3], rendered(lights[light], reflectance, normals, views))
                for photo, light in photos.items()
            ])  # fmt: skip
            rows.append(
                [
                    material,
                    f"{reflectance.roughness:.2f}",
                    *(f"{100 * e:.2f} %" for e in np.percentile(errors, [50, 95, 100])),
                ]
            )
        errors_of = table(["material", "roughness", "median", "95th percentile", "worst"], rows)
        print(errors_of, flush=True)
        times = []
        for size in (512, 256, 128):
            page.evaluate(f"viewer.seconds(3, {size})")
            seconds = page.evaluate(f"Array.from({{length: {FRAMES}}}, () => viewer.seconds(1, {size}))")
            times.append([f"{size}²", f"{1000 * min(seconds):.0f} ms", f"{1000 * np.median(seconds):.0f} ms"])
    times_of = table(["pixels", "smallest", "median"], times)
    print(times_of)
    if build.name == "eames":
        text = f"{errors_of}\n\nA frame, of {FRAMES}:\n\n{times_of}"
        refresh(ROOT / "docs/formats.md", {"viewer": text})


if __name__ == "__main__":
    main(ROOT / "build" / os.environ.get("DATASET", "eames"))
