"""What is known beforehand: unknowns of materials and lights that are held at their values while all others are found.

A known reflectance settles the factor per channel that is otherwise free in its connected component (`factorlib.inference.gauge`): scale and
white balance come from it.  So does a known light, unless its radiance is known but for one factor: then white balance alone comes from it.
Held unknowns have no rows and columns in the solver's system.

A light of known radiance on cells comes from a lat-long map, or from what a mirror ball shows.  Radiance y_i is known in directions d_i, each of
which stands for the solid angle ω_i.  The cells' weights w ≥ 0 are those of the likeliest Σ_p w_p φ_p(d_i), were y counts of a Poisson process, by
the iteration of Richardson (1972) and Lucy (1974)

    w_p ← w_p Σ_i ω_i φ_p(d_i) y_i/(Σ_q w_q φ_q(d_i)) / Σ_i ω_i φ_p(d_i)                                             (1)

which keeps w ≥ 0 and the energy Σ_i ω_i y_i as it is.  Even cells come first; then, again and again, those that hold most energy split, as
in a solve, down to `FINEST` spacings of the directions.  Cells that too few directions lie in (a ball shows nothing behind itself, and what
it shows of other objects or clipped is left out) are not known: the solve finds them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.dataset.schema import KnownSlice, LightSlice
from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere, mirror_directions
from factorlib.inference.lights import Light, even_cells
from factorlib.inference.materials import ROUGHNESS, Materials
from factorlib.light.lobes import lobe_integral, squared_distances
from factorlib.urm.observations import Observations

CELLS = 400
SPLIT = 48
SPLITTINGS = 4
FINEST = 1.0  # of the spacing of the directions: with finer cells the sums of (1) are no longer integrals
# of the last cells, and of those that split afterwards
ITERATIONS = 60
BETWEEN = 15
COVERED = 0.5  # of a cell's integral: below, it is not known
# of the mean radiance, and steradians, which keep (1) from dividing by 0
DARK = 1e-6
LEAST = 1e-12
ROWS = 128  # of a map, which is averaged down to them
LEAST_OF_A_BALL = 1000  # pixels: then what they mirror is 6° apart, and cells are 10° wide


class Known(msgspec.Struct, frozen=True):
    """materials: k_d, k_s (RGB each) and roughness by a material's number, NaN where it is not known.

    lights: by illumination, in the radiance of its photos, with the cells that are known (`Light.held`)
    exposures: illuminations whose photos' exposures are known: radiance has been divided by them
    """

    materials: dict[int, Float[np.ndarray, "7"]] = {}
    lights: dict[str, Light] = {}
    exposures: tuple[str, ...] = ()

    @property
    def nothing(self) -> bool:
        """Whether everything is to be found."""
        return not (self.materials or self.lights or self.exposures)

    def put(self, materials: Materials) -> Materials:
        """The materials with what is known in its place."""
        if not self.materials:
            return materials
        rows = materials.rows()
        for m, values in self.materials.items():
            rows[m] = np.where(np.isnan(values), rows[m], values)
        return Materials.of_rows(rows)

    def free(self, count: int) -> Bool[np.ndarray, " 7m"]:
        """Which unknowns of `count` materials are to be found."""
        free = np.ones((count, 7), bool)
        for m, values in self.materials.items():
            free[m] = np.isnan(values)
        return free.reshape(-1)

    def factors(self, members: Iterable[int], illuminations: Iterable[str]) -> Literal[0, 1, 3]:
        """How many factors stay free between the reflectances and the lights of a component: one a channel, one for all, or none."""
        lights = [self.lights[name] for name in illuminations if name in self.lights]
        if self.of(members) or not all(light.scale_free for light in lights):
            return 0
        return 1 if lights else 3

    def of(self, members: Iterable[int]) -> list[int]:
        """The known ones of some materials."""
        return [m for m in members if m in self.materials]


def known_light(
    directions: Float[np.ndarray, "n 3"], radiance: Float[np.ndarray, "n 3"], solid_angle: Float[np.ndarray, " n"]
) -> Light:
    """The light that has `radiance` in unit `directions` (in the light's frame) of n solid angles in steradians; its cells are `held` where
    directions cover them."""
    mean = solid_angle @ radiance / solid_angle.sum()
    floored = np.maximum(radiance, DARK * mean.mean())
    energy_of = (solid_angle[:, None] * floored).astype(np.float32)
    lobes = even_cells(CELLS)
    spacing = np.sqrt(np.median(solid_angle))
    light = Light(lobes.axis, np.log(lobes.sharpness), np.ones((CELLS, 3)), np.zeros(1))
    light = light.with_log_radiance(np.tile(np.log(np.maximum(mean, DARK * mean.mean()))[:, None], CELLS))
    for number in range(SPLITTINGS + 1):
        if number:
            light = light.split(light.brightest(SPLIT, 2 * FINEST * spacing))
        response = np.exp(-0.5 * light.sharpness * squared_distances(directions, light.axis)).astype(np.float32)
        covered = response.T @ solid_angle.astype(np.float32)
        weight = light.weight.astype(np.float32)
        for _ in range(ITERATIONS if number == SPLITTINGS else BETWEEN):
            weight *= response.T @ (energy_of / (response @ weight)) / np.maximum(covered, LEAST)[:, None]
        light = msgspec.structs.replace(light, weight=weight.astype(float))
    return msgspec.structs.replace(light, held=covered >= COVERED * lobe_integral(light.sharpness))


def light_of_map(lat_long: Float[np.ndarray, "h w 3"]) -> Light:
    """The light of a map in the layout of the exported ones, in the frame that these are turned from; known but for one factor."""
    height, width = lat_long.shape[:2]
    rows = min(height, ROWS)
    first = [-(-np.arange(count) * size // count) for count, size in ((rows, height), (2 * rows, width))]
    angle = np.repeat(lat_long_solid_angles(height, width)[:, None], width, axis=1)
    sums = (angle[..., None] * lat_long, angle[..., None])
    energy, angle = (np.add.reduceat(np.add.reduceat(of, first[0], axis=0), first[1], axis=1) for of in sums)
    directions = (lat_long_directions(rows, 2 * rows) @ YUP_FROM_CAMERA).reshape(-1, 3)
    light = known_light(directions, (energy / angle).reshape(-1, 3), angle.reshape(-1))
    return msgspec.structs.replace(light, scale_free=True)


def light_of_ball(seen: Observations, specular: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]) -> Light:
    """The light that a mirror ball shows, of whose k_d nothing is left, in the radiance of its photo.

    seen: its pixels;  specular: its k_s;  rotation: light_from_camera.  What shows another object, or is clipped, tells nothing.  All
    pixels of a ball stand for the same solid angle, for its picture is an equal-area projection of the sphere (from afar).
    """
    mirror = mirror_directions(seen.normal.astype(float), seen.view.astype(float))
    weight = seen.weight / np.maximum(1.0 if seen.confidence is None else seen.confidence, LEAST)
    usable = ~seen.clipped.any(1)
    if seen.visibility is not None:
        nearest = np.argmax(mirror @ fibonacci_sphere(seen.visibility.shape[1]).T, axis=1)
        usable &= seen.visibility[np.arange(len(seen)), nearest] == 255
    angle = 4 * np.pi * weight / weight.sum()
    return known_light(mirror[usable] @ rotation.T, seen.radiance[usable] / specular, angle[usable])


def what_is_known(
    given: KnownSlice,
    maps: Mapping[str, Float[np.ndarray, "h w 3"]],
    shown: Mapping[str, Observations],
    seen: Observations,
    photos: Mapping[str, LightSlice],
) -> tuple[Observations, Known]:
    """The observations `seen` without those of mirror balls, and what the solver holds.

    maps: by illumination;  shown: all usable pixels of the photo of each illumination's ball, at one exposure;  photos: the light of each.
    Raises InputError where nothing shows what is known.
    """
    number = list(seen.materials).index
    chrome = {ball.material for ball in given.balls.values()}
    for name in given.materials:
        if not (seen.material == number(name)).any():
            cure = "look at its mask and at the overlays of `align`: both must show it at the same place"
            raise InputError(f"no observation shows material '{name}'", key=f"known.materials.{name}", cure=cure)
    rows = {
        number(name): np.array(
            [*of.diffuse, *(of.specular or (np.nan,) * 3), of.roughness or (ROUGHNESS[0] if name in chrome else np.nan)]
        )
        for name, of in given.materials.items()
    }
    lights = {name: light_of_map(lat_long) for name, lat_long in maps.items()}
    for name, ball in given.balls.items():
        m = number(ball.material)
        of_photo = seen.photo == seen.photos.index(ball.photo)
        pixels = shown[name].take(shown[name].material == m)
        rest = ~(of_photo & (seen.material == m))
        if len(pixels) < LEAST_OF_A_BALL or not (of_photo & rest).any():
            fault = f"photo '{ball.photo}' shows {len(pixels)} pixels of the ball, and {(of_photo & rest).sum()} observations of other objects"
            cure = f"the ball needs {LEAST_OF_A_BALL}, and something beside it: look at the overlay of `align`"
            raise InputError(fault, key=f"known.illumination.{name}.chrome", cure=cure)
        world = photos[ball.photo].world_from_camera
        lights[name] = light_of_ball(pixels, rows[m][3:6], np.eye(3) if world is None else np.array(world))
        seen = seen.take(rest)
    return seen, Known(rows, lights, tuple(sorted({photos[photo].illumination for photo in given.exposure})))
