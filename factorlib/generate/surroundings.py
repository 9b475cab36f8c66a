"""Surroundings that light a scene: a sky with its sun over a ground, and rooms with windows and lamps.

Every surrounding is a dictionary of Mitsuba objects in a world with y up and its ground or floor at y = −EYE. Nothing
is within a metre of the origin, so that the light that arrives at the origin, or at a chair on the floor, can be
traced. Radiance is in arbitrary units: a data set scales each light by its photo's exposure. The module also makes
random materials.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.light_map import read_light_map
from factorlib.results.materials import Reflectance, vec3
from factorlib.tracing.scene import envmap, incident_light, rgb, transform
from factorlib.tracing.variant import mitsuba

EYE = 1.2  # height of the origin above the ground
# the zenith of sunsky is its +z, but its sun_direction is in the world's frame
Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
SUN_SCALE = 0.12  # radiance of the sun relative to the real one
SUN_APERTURE_DEG = 3.0  # diameter of the sun
GROUND = (0.32, 0.3, 0.26)  # reflectance
Colour = float | Sequence[float] | Float[np.ndarray, "3"]  # linear Rec. 709; a number is grey
Rotation = Float[np.ndarray, "3 3"]
Rng = np.random.Generator
SceneDict = dict[str, Any]  # shapes and emitters by name, as Mitsuba's `load_dict` takes them
# rotations about x and about y that take +z to each side
TURNS = {"+x": (0, 90), "-x": (0, -90), "+z": (0, 0), "-z": (0, 180), "+y": (-90, 0), "-y": (90, 0)}


def random_materials(rng: np.random.Generator, spread: float, about: dict[str, Reflectance]) -> dict[str, Reflectance]:
    """Vary materials at random: each number times exp(spread · normal), within k_d + k_s ≤ 0.95, to four digits.

    Args:
        rng: Random generator.
        spread: Deviation of the logarithms.
        about: Materials by name.

    Returns:
        Materials by name.
    """
    result = {}
    for name, material in about.items():
        factor = np.exp(spread * rng.standard_normal(5))
        colours = np.array([np.array(material.diffuse) * factor[:3], np.array(material.specular) * factor[3]])
        colours *= min(1.0, 0.95 / (colours[0].max() + colours[1].max()))
        roughness = float(np.clip(material.roughness * factor[4], 0.15, 0.8))
        diffuse, specular = (vec3(round(float(v), 4) for v in colour) for colour in colours)
        result[name] = Reflectance(diffuse, specular, round(roughness, 4))
    return result


def daylight(rng: Rng, elevation_deg: float, azimuth_deg: float, turbidity: float = 4.0, rows: int = 256) -> SceneDict:
    """Return a clear sky (Hosek and Wilkie 2012, 2013, by Mitsuba's `sunsky`) over a ground with some painted walls.

    The sun is veiled: wider (SUN_APERTURE_DEG) and weaker (SUN_SCALE) than the real one, whose 0.5° only a mirror
    shows.

    Args:
        rng: Random generator.
        elevation_deg: Elevation of the sun.
        azimuth_deg: Azimuth of the sun, from +z toward +x.
        turbidity: Turbidity of the sky.
        rows: Rows of the map that stands for the sky, which Mitsuba samples with less noise than the model itself.

    Returns:
        Mitsuba objects by name.
    """
    up, turn = np.radians([elevation_deg, azimuth_deg])
    sun = [np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)]
    sky = {
        "type": "sunsky",
        "turbidity": turbidity,
        "sun_scale": SUN_SCALE,
        "sun_aperture": SUN_APERTURE_DEG,
        "albedo": 0.3,
        "sun_direction": [float(c) for c in sun],
        "to_world": transform(Y_UP_FROM_Z_UP),
    }
    sky_map = incident_light({"sky": sky}, np.eye(4), rows, 4, 0, max_depth=2)
    scene = {"sky": envmap(sky_map, finer=2), "ground": wall("-y", EYE, (200, 200), GROUND)}
    for k in range(4):  # coloured blocks some metres away, none in front of the sun
        angle = np.radians(azimuth_deg + 60 + 80 * k + rng.uniform(-20, 20))
        size = np.array([rng.uniform(1.5, 3), rng.uniform(1, 3), rng.uniform(1, 2)])
        place = np.array([np.sin(angle), 0, np.cos(angle)]) * rng.uniform(8, 12) + [0, size[1] - EYE, 0]
        scene[f"facade_{k}"] = rotated_box(place, size, np.degrees(angle), _vivid_colour(rng))
    return scene


def room(rng: Rng, windows: int, lamps: int, clear_deg: float = 0.0, clear_half_deg: float = 75.0) -> SceneDict:
    """Return a closed room of coloured walls with bright windows, warm lamps, pictures and furniture.

    Args:
        rng: Random generator.
        windows: Number of windows, at most 4.
        lamps: Number of lamps.
        clear_deg: Azimuth about which there is no furniture.
        clear_half_deg: Half width of that range.

    Returns:
        Mitsuba objects by name.
    """
    half = np.array([rng.uniform(2.6, 3.6), rng.uniform(1.1, 1.5), rng.uniform(2.6, 3.6)])
    ceiling = 2.9 - EYE
    scene = {
        "floor": wall("-y", EYE, half[[0, 2]], rng.uniform(0.15, 0.45) * np.array([1.2, 0.95, 0.7])),
        "ceiling": wall("+y", ceiling, half[[0, 2]], (0.75, 0.74, 0.7)),
    }
    sides = ["+x", "-x", "+z", "-z"]
    for side in sides:
        distance, width = (half[0], half[2]) if side[1] == "x" else (half[2], half[0])
        paint = np.clip(rng.uniform(0.45, 0.75) + rng.uniform(-0.2, 0.15, 3), 0.1, 0.85)
        scene[f"wall{side}"] = wall(side, distance, (width, 1.6), paint, (0, 0.25))
        size = rng.uniform(0.3, 0.6, 2)
        colour = _vivid_colour(rng)
        shift = rng.uniform(-1.6, 1.6), rng.uniform(0, 0.5)
        scene[f"picture{side}"] = wall(side, distance - 0.02, size, colour, shift)
    for k, side in enumerate(rng.permutation(sides)[:windows]):
        distance = (half[0] if side[1] == "x" else half[2]) - 0.03
        day = rng.uniform(9, 16) * np.array([0.85, 1.0, 1.15])
        pane = rng.uniform(0.5, 0.9), 0.7
        shift = rng.uniform(-1, 1), 0.45
        scene[f"window_{k}"] = wall(side, distance, pane, 0, shift, glow=day)
    for k in range(lamps):
        across = rng.uniform(0.5, 0.8) * half[0] * rng.choice([-1, 1])
        place = [across, rng.uniform(0.4, 1.2), rng.uniform(0.4, 0.8) * half[2] * rng.choice([-1, 1])]
        warm = {"type": "area", "radiance": rgb(rng.uniform(40, 70) * np.array([1.25, 0.95, 0.55]))}
        scene[f"lamp_{k}"] = {"type": "sphere", "center": place, "radius": rng.uniform(0.12, 0.18), "emitter": warm}
    for k in range(4):
        angle = np.radians(clear_deg + clear_half_deg + rng.uniform(0, 1) * (360 - 2 * clear_half_deg))
        size = rng.uniform([0.25, 0.2, 0.25], [0.5, 0.6, 0.5])
        place = np.array([np.sin(angle), 0, np.cos(angle)]) * rng.uniform(1.9, 2.3) + [0, size[1] - EYE, 0]
        scene[f"block_{k}"] = rotated_box(place, size, np.degrees(angle), _vivid_colour(rng))
    return scene


def _vivid_colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Draw a saturated colour."""
    return 0.06 + 0.65 * rng.dirichlet([0.7, 0.7, 0.7])


def wall(
    side: str,
    distance: float,
    half: Iterable[float],
    colour: Colour,
    shift: Sequence[float] = (0.0, 0.0),
    glow: Colour | None = None,
) -> SceneDict:
    """Return a rectangle that faces the origin.

    Args:
        side: Direction from the origin to the wall, such as "+x".
        distance: Distance from the origin.
        half: Half width and half height.
        colour: Reflectance.
        shift: Offset of its centre in its own plane (along, up).
        glow: Emitted radiance; None for a wall that only reflects.

    Returns:
        A Mitsuba object.
    """
    pitch, yaw = TURNS[side]
    to_world = mitsuba().ScalarTransform4f().rotate([0, 1, 0], yaw).rotate([1, 0, 0], pitch)
    to_world = to_world.translate([*shift, distance]).rotate([0, 1, 0], 180).scale([*map(float, half), 1])
    shape = {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": rgb(colour)}}
    return shape if glow is None else shape | {"emitter": {"type": "area", "radiance": rgb(glow)}}


def rotated_box(
    place: Float[np.ndarray, "3"], half: Float[np.ndarray, "3"], turn_deg: float, colour: Colour
) -> SceneDict:
    """Return a box rotated about y.

    Args:
        place: Centre.
        half: Half sizes.
        turn_deg: Angle of the rotation.
        colour: Reflectance.

    Returns:
        A Mitsuba object.
    """
    to_world = mitsuba().ScalarTransform4f().translate([*map(float, place)]).rotate([0, 1, 0], float(turn_deg))
    to_world = to_world.scale([*map(float, half)])
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": rgb(colour)}}


def read_captured_light(path: Path, height: int) -> Float[np.ndarray, "h w 3"]:
    """Read a user's lat-long map (.exr, .hdr), averaged to `height` rows and scaled to a mean radiance of 1."""
    radiance = read_light_map(path)
    if (rows := len(radiance)) % height:
        raise InputError(
            f"its {rows} rows are not a multiple of {height}",
            file=path,
            cure=f"resize it to a multiple of {height} rows",
        )
    radiance = radiance.reshape(height, rows // height, 2 * height, rows // height, 3).mean(axis=(1, 3))
    return radiance / radiance.mean()
