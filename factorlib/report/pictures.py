"""Pictures of the report: photos beside re-syntheses, balls, and lights."""

from collections.abc import Mapping, Sequence
from math import ceil
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL.ImageColor import getrgb
from scipy.ndimage import binary_erosion
from scipy.sparse import csr_array

from factorlib.conventions import lat_long_solid_angles
from factorlib.dataset.schema import ObjectsSlice
from factorlib.evaluate.picture_errors import agreeing_pixels
from factorlib.images.picture import data_uri, exposure_of, nearest_tags, picture, png_bytes
from factorlib.images.tone import srgb_encode
from factorlib.render.photo_scene import TracedPicture, rotate_light, traced_photo
from factorlib.render.solved_set import SolvedSet
from factorlib.report.artifacts import Artifacts, Channels, Picture
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Reflectance
from factorlib.results.metrics import PhotoErrors, ScoredLight

FIRST_SAMPLES = 16  # samples per pixel of the first screen's pictures
AMPLIFICATION = 4  # factor on the difference between photo and re-synthesis
UNCOUNTED = np.array([0.45, 0.38, 0.62])  # sRGB colour of pixels in the mask that are not compared
DISAGREES = np.array([0.92, 1.0, 0.0])  # sRGB colour of pixels where mesh and mask name different materials
MAGENTA = (214, 40, 120)
UNKNOWN = Reflectance((0.2,) * 3, (0.0,) * 3, 1.0)  # stands for a material that was not solved
CLAY_LIGHT = np.array([-0.5, -0.6, -0.6245])  # camera frame, unit: from above, left of the camera

Pixels = UInt8[np.ndarray, "h w c"]


def downsample(picture: Float[np.ndarray, "h w c"], longest: int) -> Float[np.ndarray, "H W c"]:
    """Downsample by area averages until no side is longer than `longest` pixels; a small picture is unchanged."""
    height, width = picture.shape[:2]
    scale = min(1.0, longest / max(height, width))
    if scale == 1.0:
        return picture

    def average(rows: Float[np.ndarray, "n m c"]) -> Float[np.ndarray, "N m c"]:
        """Downsample rows: means weighted by the overlap of source and target rows."""
        target = max(1, round(len(rows) * scale))
        edges = np.arange(target + 1) * (len(rows) / target)
        cells = np.arange(len(rows))
        overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
        means = csr_array(np.maximum(overlap, 0) * (target / len(rows))) @ rows.reshape(len(rows), -1)
        return means.reshape(target, *rows.shape[1:]).astype(np.float32)

    return average(average(picture).swapaxes(0, 1)).swapaxes(0, 1)


def mask_box(mask: Bool[np.ndarray, "h w"], margin: float = 0.06) -> tuple[slice, slice]:
    """Return rows and columns of the mask's bounding box; the whole picture for an empty mask.

    `margin` is the margin as a fraction of the box's longer side.
    """
    if not mask.any():
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    spans = [np.nonzero(mask.any(axis=1 - axis))[0][[0, -1]] for axis in (0, 1)]
    extra = int(np.ceil(margin * max(b - a + 1 for a, b in spans)))
    rows, columns = (slice(max(0, a - extra), min(n, b + 1 + extra)) for (a, b), n in zip(spans, mask.shape))
    return rows, columns


def outline(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the mask that touch its outside; the picture's border does not count as outside."""
    return mask & ~binary_erosion(mask, border_value=1)


def ball_rgba(radiance: Float[np.ndarray, "n n 3"], exposure: float) -> UInt8[np.ndarray, "n n 4"]:
    """Return the display values of a ball that fills the picture, transparent around it."""
    height, width = radiance.shape[:2]
    y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (height, width))
    alpha = np.clip((1 - np.hypot(x[None], y[:, None])) * height / 2 + 0.5, 0, 1)
    return np.concatenate([picture(radiance, exposure), np.rint(255 * alpha)[..., None].astype(np.uint8)], axis=-1)


def exposures(run: Artifacts) -> dict[str, float]:
    """Return the display exposure of each photo, which balls in its light share."""
    photos = metrics.photos if (metrics := run.metrics) else {}
    return {name: photos[name].exposure if name in photos else 1.0 for name in run.set.photos}


# ── Photos ───────────────────────────────────────────────────────────────────────────────────────────────────────────


class PhotoRow(msgspec.Struct, frozen=True):
    """A photo with its panels and errors.

    Attributes:
        panels: sRGB pixels of one crop, by title
        uris: the panels as `data:` URIs
        errors: errors of the re-synthesis, if there are any
    """

    name: str
    illumination: str
    panels: dict[str, Pixels]
    uris: dict[str, str]
    errors: PhotoErrors | None


def material_tags(run: Artifacts) -> dict[str, str]:
    """Return a colour "#rrggbb" for each material of the set, near its diffuse colour, or a metal's specular colour."""
    reflectances = [run.exported.materials.get(name, UNKNOWN) for name in run.set.materials]
    colours = [np.add(m.diffuse, np.multiply(0.15, m.specular)) for m in reflectances]
    return nearest_tags(run.set.materials, np.array(colours))


def longest_side(photos: int) -> int:
    """Return the longer side of a panel in pixels, smaller for many photos to keep the page small."""
    return 440 if photos <= 12 else 300


def photo_row(run: Artifacts, name: str, tags: dict[str, str], errors: PhotoErrors | None) -> PhotoRow:
    """Return a photo's panels: photo, materials, re-synthesis and difference.

    Args:
        run: results of the run
        name: name of the photo
        tags: colours of the materials in masks, by name
        errors: the photo's entry of the metrics
    """
    masks = run.channels("masks", name)
    geometry = run.channels("align", name)
    resynthesis = run.rgb("render", f"resynthesis/{name}")
    exposure = errors.exposure if errors else 1.0
    box = mask_box(np.rint(masks["label"]) > 0)
    masks, geometry = ({k: v[box] for k, v in channels.items()} for channels in (masks, geometry))
    photo = np.nan_to_num(np.stack([masks[c] for c in "RGB"], axis=-1), posinf=0, neginf=0)
    display = picture(photo, exposure).astype(np.float32) / 255
    in_mask = masks["label"] > 0.5
    panels = {"photo": display, "materials": _labels(masks, geometry, photo * exposure, list(tags.values()))}
    if resynthesis is not None:
        resynthesis = picture(np.nan_to_num(resynthesis[box], posinf=0, neginf=0), exposure).astype(np.float32) / 255
        explained = in_mask & (np.rint(masks["label"]) == np.rint(geometry["label"]))
        panels["re-synthesis"] = np.concatenate([resynthesis, explained[..., None]], axis=-1)
        difference = 0.5 + AMPLIFICATION * (resynthesis - display)  # grey where equal
        clipped = np.any([masks[f"clipped.{c}"] > 0.5 for c in "RGB"], axis=0)
        difference[~agreeing_pixels(masks, geometry) | clipped] = UNCOUNTED
        panels["difference"] = np.concatenate([np.clip(difference, 0, 1), in_mask[..., None]], axis=-1)
    longest = longest_side(len(run.set.photos))
    pixels = {k: np.rint(255 * np.clip(downsample(v, longest), 0, 1)).astype(np.uint8) for k, v in panels.items()}
    return PhotoRow(name, run.illumination_of(name), pixels, {k: data_uri(v) for k, v in pixels.items()}, errors)


def first_pictures(run: Artifacts, rows: Sequence[PhotoRow], results: SolvedSet) -> list[tuple[str, str, str]]:
    """Return the pictures of the first screen: the photo with the most counted pixels, and two path-traced pictures.

    These show its objects in their own light and in another photo's.

    Args:
        run: results of the run
        rows: pictures and errors of each photo
        results: the solved data set

    Returns:
        Title, `data:` URI and caption of each picture.
    """
    row = max(rows, key=lambda row: row.errors.pixels if row.errors else 0)
    photo = ("photo", row.uris["photo"], row.name)
    lobes = run.read(read_lobes, "export", "lobes.parquet") or {}
    lit = {name for name, light in lobes.items() if len(light)}  # lights that were solved
    if not results.objects[row.name].objects or row.illumination not in lit:
        return [photo]
    # camera cropped to the objects, and enlarged to the panel's size
    scene = results.scene(row.name)
    box = mask_box(np.rint(run.channels("masks", row.name)["label"]) > 0)
    top, left = (span.start for span in box)
    height, width = (span.stop - span.start for span in box)
    pixel = max(1.0, max(height, width) / longest_side(len(run.set.photos)))
    camera = scene.camera.window(left, top, pixel, ceil(width / pixel), ceil(height / pixel))
    scene = msgspec.structs.replace(scene, camera=camera)
    rerendered = TracedPicture(traced_photo(scene, FIRST_SAMPLES), results.tone(row.name))
    others = [p for p in run.set.photos if run.illumination_of(p) in lit - {row.illumination}]
    other_light = others[0] if others else None
    light = results.light(other_light, row.name) if other_light else rotate_light(scene.light, 180.0, scene.up)
    relit = TracedPicture(traced_photo(msgspec.structs.replace(scene, light=light), FIRST_SAMPLES))
    exposure = row.errors.exposure if row.errors else 1.0
    caption = f"in the light of {other_light}" if other_light else "in its own light, turned half around"
    return [
        photo,
        ("re-synthesis", data_uri(rerendered.rgba(exposure)), "path-traced from what was recovered"),
        ("relit", data_uri(relit.with_exposure().rgba()), caption),
    ]


def _labels(masks: Channels, geometry: Channels, photo: Picture, tags: list[str]) -> Picture:
    """Tint a grey photo (already exposed) by material; yellow where mesh and mask name different materials."""
    grey = srgb_encode(np.clip(photo.mean(axis=-1), 0, 1))[..., None] * np.ones(3)
    label = np.rint(masks["label"]).astype(int)
    colours = np.array([(0, 0, 0), *(getrgb(tag) for tag in tags)]) / 255
    display = np.where((label > 0)[..., None], 0.45 * grey + 0.55 * colours[label], 0.3 + 0.5 * grey)
    display[(np.rint(geometry["label"]) != label) & (masks.get("left_out", 0 * label) < 0.5)] = DISAGREES
    return display


def surface_rows(run: Artifacts, objects: Mapping[str, ObjectsSlice]) -> list[dict[str, Any]]:
    """Return a row for every mesh with displacements, detail of reflectance or textures, sorted by name.

    `uris` are pictures by title, of the mesh as given and as refined, in the photo that shows most of it.  `typical` is
    the RMS displacement and `largest` the largest, over the extent.
    """
    rows = []
    table = run.surface
    for mesh in sorted({*table.displacements, *table.log_factors, *run.texture.longest}):
        masks = {}
        for photo, slice_ in objects.items():
            numbers = [number for number, obj in enumerate(slice_.objects, start=1) if obj.mesh == mesh]
            masks[photo] = np.isin(np.rint(run.channels("align", photo)["object"]), numbers or [-1])
        photo = max(masks, key=lambda name: int(masks[name].sum()))
        maps = {"as given": run.channels("align", photo)}
        if table.moved or table.painted:
            maps["by shading"] = run.channels("surface", f"photos/{photo}")
        normals = {kind: np.stack([each[f"normal.{a}"] for a in "xyz"], axis=-1) for kind, each in maps.items()}
        panels = {
            f"clay, {kind}": srgb_encode(0.03 + 0.5 * np.maximum(n @ CLAY_LIGHT, 0)) for kind, n in normals.items()
        }
        panels |= {f"normals, {kind}": 0.5 + 0.5 * n * (1, -1, -1) for kind, n in normals.items()}
        paint = {"detail of reflectance": maps["by shading"]} if mesh in table.log_factors else {}
        if mesh in run.texture.longest:
            paint = {"texture, a factor on the diffuse reflectance": run.channels("texture", f"photos/{photo}")}
        panels |= {
            title: srgb_encode(np.clip(0.4 * np.stack([each[f"detail.{c}"] for c in "RGB"], axis=-1), 0, 1))
            for title, each in paint.items()
        }
        uris = {}
        box = mask_box(masks[photo])
        longest = longest_side(len(run.set.photos))
        for title, panel in panels.items():
            colour = panel if panel.ndim == 3 else panel[..., None].repeat(3, 2)
            small = downsample(np.where(masks[photo][..., None], colour, 1.0)[box].astype(np.float32), longest)
            uris[title] = data_uri(np.rint(255 * np.clip(small, 0, 1)).astype(np.uint8))
        # RMS and largest displacement, relative to the extent
        size = np.abs(table.displacements.get(mesh, [0.0]))
        moved = {"typical": float(np.sqrt(np.mean(size**2))), "largest": float(size.max())}
        rows.append({"mesh": mesh, "photo": photo, "uris": uris, **moved})
    return rows


def strip(row: PhotoRow) -> bytes:
    """Return a row's panels side by side on white, as a PNG."""
    panels = [pixels.astype(np.float32) for pixels in row.panels.values()]
    alphas = [each[..., 3:] / 255 if each.shape[2] == 4 else 1.0 for each in panels]
    opaque = [each[..., :3] * alpha + 255 * (1 - alpha) for each, alpha in zip(panels, alphas)]
    return png_bytes(np.rint(np.concatenate(opaque, axis=1)).astype(np.uint8))


# ── Materials in lights ──────────────────────────────────────────────────────────────────────────────────────────────


def ball_cell(run: Artifacts, material: str, photo: str, exposure: float) -> dict[str, Any]:
    """Return the page's cell of the ball of a material in a photo's light.

    `observed` says whether the photo shows the material.  `uri` is the rendering, or None.

    Args:
        run: results of the run
        material: name of the material
        photo: name of the photo
        exposure: exposure of the picture
    """
    observed = photo in run.photo_facts and run.photo_facts[photo].pixels.get(material, 0) > 0
    radiance = run.rgb("render", f"materials/{photo}/{material}")
    uri = None if radiance is None else data_uri(ball_rgba(downsample(radiance, 96), exposure))
    return {"material": material, "photo": photo, "observed": observed, "uri": uri}


# ── Lights ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def light_row(
    run: Artifacts, name: str, photos: list[str], errors: dict[str, dict[str, ScoredLight]] | None
) -> dict[str, Any] | None:
    """Return the page's row of a light; None if it was not exported.

    The row has these keys.
    uri, dark_uri, true_uri, spheres: the map, the map 4 stops darker, the true map, three spheres
    white: radiance shown as white
    peak: brightest texel in units of white
    overflow: share of the sphere above white, which is outlined
    energy: share of the light's energy above white
    known: share of the sphere where the standard error is below the radiance
    known_uri: standard error over radiance r as grey 1 / (1 + r): white for none, mid-grey for 1
    sun: the decision on a sun; None if none was looked for

    Args:
        run: results of the run
        name: name of the light
        photos: photos of the light
        errors: its part of metrics.json
    """
    radiance = run.rgb("export", f"illumination/{name}")
    if radiance is None:
        return None
    exposure = exposure_of(radiance, percentile=95.0)
    brightest = radiance.max(axis=-1) * exposure
    area = lat_long_solid_angles(*radiance.shape[:2])[:, None]
    over = brightest > 1
    energy = radiance.sum(axis=-1) * area
    true = run.rgb("evaluate", f"illumination/{name}")
    known = run.rgb("export", f"coverage/{name}")
    row = {
        "name": name, "photos": photos, "errors": errors, "white": 1 / exposure, "peak": float(brightest.max()),
        "uri": _outline_bright(radiance, exposure),
        "dark_uri": data_uri(picture(radiance, exposure / 16)),
        "overflow": float((over * area).sum() / (4 * np.pi)),
        "energy": float((energy * over).sum() / max(energy.sum(), 1e-30)),
        "true_uri": None if true is None else _true_map(true, radiance, exposure),
        "known_uri": None, "known": None, "spheres": _spheres(run, name),
        "sun": run.solved.model.suns_chosen_by.get(name),
    }  # fmt: skip
    if known is not None:
        # standard error relative to the radiance of each texel
        mean = float((radiance * area[..., None]).sum() / (3 * area.sum() * radiance.shape[1]))
        error = known.mean(axis=-1) * mean / np.maximum(radiance.mean(axis=-1), 1e-30)
        row["known"] = float(((error < 1) * area).sum() / (4 * np.pi))
        row["known_uri"] = data_uri(np.rint(255 / (1 + np.repeat(error[..., None], 3, -1))).astype(np.uint8))
    return row


def _outline_bright(radiance: Picture, exposure: float) -> str:
    """Return a light with the texels above white outlined."""
    pixels = picture(radiance, exposure)
    pixels[outline((radiance * exposure).max(axis=-1) > 1)] = MAGENTA
    return data_uri(pixels)


def _true_map(true: Picture, estimate: Picture, exposure: float) -> str:
    """Return the true map scaled to the mean of the estimate, because the overall scale is a gauge freedom."""
    means = [
        float((m * (lat_long_solid_angles(*m.shape[:2])[:, None, None] / m.shape[1])).sum()) for m in (true, estimate)
    ]
    return _outline_bright(downsample(true, max(estimate.shape[:2])) * (means[1] / max(means[0], 1e-30)), exposure)


def _spheres(run: Artifacts, name: str) -> str | None:
    """Return the spheres of the truth above those of the estimate, which is scaled to the truth's mean."""
    truth, estimate = (run.rgb("evaluate", f"spheres/{name}_{kind}") for kind in ("truth", "estimate"))
    if truth is None or estimate is None:
        return None
    exposure = exposure_of(truth, truth.max(-1) > 0, 97.0)
    rows = [truth, estimate * (truth.mean() / max(float(estimate.mean()), 1e-30))]
    balls = [[np.repeat(np.repeat(ball, 2, 0), 2, 1) for ball in np.split(row, 3, axis=1)] for row in rows]
    discs = [[np.pad(ball_rgba(ball, exposure), ((4, 4), (0, 8), (0, 0))) for ball in row] for row in balls]
    return data_uri(np.concatenate([np.concatenate(row, axis=1) for row in discs]))
