"""Known reflectances, lights and exposures, which the solver holds fixed while it estimates the rest.

A known reflectance fixes the factor per channel that is otherwise free in its connected component
(`factorlib.inference.model.gauge`): scale and white balance follow from it.  So does a known light.  A light that is
known up to one factor fixes white balance alone.  Held unknowns have no rows and columns in the solver's system.

A light of known radiance on cells comes from a lat-long map or from the photo of a mirror ball.  The radiance y_i is
known in directions d_i, each with a solid angle ω_i.  The cells' weights w ≥ 0 maximise the likelihood of Σ_p w_p
φ_p(d_i), with y as counts of a Poisson process, by the iteration of Richardson (1972) and Lucy (1974)

    w_p ← w_p Σ_i ω_i φ_p(d_i) y_i/(Σ_q w_q φ_q(d_i)) / Σ_i ω_i φ_p(d_i)                                            (1)

It keeps w ≥ 0 and the energy Σ_i ω_i y_i.  Even cells come first.  Then the cells with most energy split repeatedly, as
in a solve, down to `FINEST_CELL` spacings of the directions.  A cell that too few directions cover is not known, and
the solve estimates it.  A ball does not show the directions behind itself; its pixels that are clipped or that mirror
other objects are left out.
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
from factorlib.inference.model.lights import Light, fibonacci_cells
from factorlib.inference.model.materials import ROUGHNESS, UNKNOWNS, Materials
from factorlib.light.lobes import lobe_energy, squared_distances
from factorlib.urm.observations import Observations

START_CELLS = 400  # even cells at the start
SPLIT_CELLS = 48  # cells that split at once
SPLITTING_ROUNDS = 4  # number of splittings
FINEST_CELL = (
    1.0  # least size of cells in spacings of the directions: finer cells turn the sums of (1) into poor integrals
)
ITERATIONS = 60  # iterations of (1) after the last splitting
ITERATIONS_BETWEEN = 15  # iterations of (1) before each splitting
LEAST_COVERAGE = 0.5  # least covered share of a known cell's integral
# Both keep (1) from dividing by 0.
LEAST_RELATIVE_RADIANCE = 1e-6  # least radiance, as a share of the mean
LEAST_SOLID_ANGLE = 1e-12  # least solid angle, steradians
MAP_ROWS = 128  # most rows of a map; a larger one is averaged down
# Class of the prior on materials by kind, where they differ in name.
CLASSES = dict.fromkeys(("plastic", "paint", "wood", "stone"), "dielectric")
LEAST_BALL_PIXELS = 1000  # pixels: they mirror directions 6° apart, and cells are 10° wide


class KnownValues(msgspec.Struct, frozen=True):
    """Known values of materials, lights and exposures.

    Attributes:
        materials: k_d, k_s (RGB each) and roughness by number of the material; NaN for an unknown value.
        classes: Class of the prior on materials (`factorlib.inference.model.material_prior`) by number of the material.
        lights: Light by illumination, in the radiance of its photos, with its known cells (`Light.fixed`).
        exposures: Illuminations whose photos have known exposures; radiance has been divided by them.
    """

    materials: dict[int, Float[np.ndarray, "7"]] = {}
    classes: dict[int, str] = {}
    lights: dict[str, Light] = {}
    exposures: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if no value is known."""
        return not (self.materials or self.lights or self.exposures)

    def insert_into(self, materials: Materials) -> Materials:
        """Return the materials with their known values inserted."""
        if not self.materials:
            return materials
        rows = materials.rows()
        for m, values in self.materials.items():
            rows[m] = np.where(np.isnan(values), rows[m], values)
        return Materials.from_rows(rows)

    def free(self, count: int) -> Bool[np.ndarray, " 7m"]:
        """Return a mask of the unknowns of `count` materials that are to be estimated."""
        free = np.ones((count, UNKNOWNS), bool)
        for m, values in self.materials.items():
            free[m] = np.isnan(values)
        return free.reshape(-1)

    def free_factors(self, members: Iterable[int], illuminations: Iterable[str]) -> Literal[0, 1, 3]:
        """Return the number of free factors between reflectances and lights of a component.

        It is 3 (one a channel), 1 (one for all channels) or 0.
        """
        lights = [self.lights[name] for name in illuminations if name in self.lights]
        if self.known_materials(members) or not all(light.scale_free for light in lights):
            return 0
        return 1 if lights else 3

    def known_materials(self, members: Iterable[int]) -> list[int]:
        """Return the known ones among some materials."""
        return [m for m in members if m in self.materials]


def fit_known_light(
    directions: Float[np.ndarray, "n 3"], radiance: Float[np.ndarray, "n 3"], solid_angle: Float[np.ndarray, " n"]
) -> Light:
    """Return the light with a given radiance in given directions, by (1).

    Cells that the directions cover are `fixed`.

    Args:
        directions: Unit vectors, in the light's frame.
        radiance: y, radiance in each direction.
        solid_angle: ω of each direction, steradians.
    """
    mean = solid_angle @ radiance / solid_angle.sum()
    floored = np.maximum(radiance, LEAST_RELATIVE_RADIANCE * mean.mean())
    energy_of = (solid_angle[:, None] * floored).astype(np.float32)
    lobes = fibonacci_cells(START_CELLS)
    spacing = np.sqrt(np.median(solid_angle))
    light = Light(lobes.axis, np.log(lobes.sharpness), np.ones((START_CELLS, 3)), np.zeros(1))
    light = light.with_log_radiance(
        np.tile(np.log(np.maximum(mean, LEAST_RELATIVE_RADIANCE * mean.mean()))[:, None], START_CELLS)
    )
    for number in range(SPLITTING_ROUNDS + 1):
        if number:
            light = light.split(light.brightest_cells(SPLIT_CELLS, 2 * FINEST_CELL * spacing))
        response = np.exp(-0.5 * light.sharpness * squared_distances(directions, light.axis)).astype(np.float32)
        covered = response.T @ solid_angle.astype(np.float32)
        weight = light.weight.astype(np.float32)
        # Richardson–Lucy iterations, (1)
        for _ in range(ITERATIONS if number == SPLITTING_ROUNDS else ITERATIONS_BETWEEN):
            weight *= response.T @ (energy_of / (response @ weight)) / np.maximum(covered, LEAST_SOLID_ANGLE)[:, None]
        light = msgspec.structs.replace(light, weight=weight.astype(float))
    return msgspec.structs.replace(light, fixed=covered >= LEAST_COVERAGE * lobe_energy(light.sharpness))


def light_from_map(lat_long: Float[np.ndarray, "h w 3"]) -> Light:
    """Return the light of a lat-long map, known up to one factor.

    The map has the layout of the exported ones.  The light is in the frame that these are turned from.
    """
    height, width = lat_long.shape[:2]
    rows = min(height, MAP_ROWS)
    edges = [-(-np.arange(count) * size // count) for count, size in ((rows, height), (2 * rows, width))]
    angle = np.repeat(lat_long_solid_angles(height, width)[:, None], width, axis=1)
    # radiance averaged over blocks of texels, weighted by solid angle
    sums = (angle[..., None] * lat_long, angle[..., None])
    energy, angle = (np.add.reduceat(np.add.reduceat(values, edges[0], axis=0), edges[1], axis=1) for values in sums)
    directions = (lat_long_directions(rows, 2 * rows) @ YUP_FROM_CAMERA).reshape(-1, 3)
    light = fit_known_light(directions, (energy / angle).reshape(-1, 3), angle.reshape(-1))
    return msgspec.structs.replace(light, scale_free=True)


def light_from_ball(
    observations: Observations, specular: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"]
) -> Light:
    """Return the light that a mirror ball shows, in the radiance of its photo.

    The ball's diffuse reflectance is neglected.  All its pixels stand for the same solid angle, because from afar the
    picture of a mirror ball is an equal-area projection of the sphere.  Pixels that are clipped or that mirror another
    object are not used.

    Args:
        observations: Observations of the ball.
        specular: k_s of the ball.
        rotation: light_from_camera.
    """
    mirror = mirror_directions(observations.normal.astype(float), observations.view.astype(float))
    weight = observations.weight / np.maximum(
        1.0 if observations.confidence is None else observations.confidence, LEAST_SOLID_ANGLE
    )
    usable = ~observations.clipped.any(1)
    # keep pixels whose mirrored direction is not hidden by another object
    if observations.visibility is not None:
        nearest = np.argmax(mirror @ fibonacci_sphere(observations.visibility.shape[1]).T, axis=1)
        usable &= observations.visibility[np.arange(len(observations)), nearest] == 255
    # equal-area projection: solid angle in proportion to pixels
    angle = 4 * np.pi * weight / weight.sum()
    return fit_known_light(mirror[usable] @ rotation.T, observations.radiance[usable] / specular, angle[usable])


def extract_known(
    declared: KnownSlice,
    maps: Mapping[str, Float[np.ndarray, "h w 3"]],
    balls: Mapping[str, Observations],
    observations: Observations,
    photos: Mapping[str, LightSlice],
) -> tuple[Observations, KnownValues]:
    """Return the observations without mirror balls, and the known values that the solver holds fixed.

    Args:
        declared: Known values in dataset.yaml.
        maps: Lat-long maps by illumination.
        balls: All usable pixels of each ball's photo, at one exposure, by illumination.
        observations: Observations.
        photos: Illumination of each photo.

    Raises:
        InputError: If no observation shows a known material, or a ball's photo shows too little of the ball or nothing
            else.
    """
    number = list(observations.materials).index
    rows = {number(name): row for name, row in _known_rows(declared, observations).items()}
    lights = {name: light_from_map(lat_long) for name, lat_long in maps.items()}
    for name, ball in declared.balls.items():
        m = number(ball.material)
        photo_mask = observations.photo == observations.photos.index(ball.photo)
        pixels = balls[name].take(balls[name].material == m)
        beside_ball = ~(photo_mask & (observations.material == m))
        if len(pixels) < LEAST_BALL_PIXELS or not (photo_mask & beside_ball).any():
            fault = (
                f"photo '{ball.photo}' shows {len(pixels)} pixels of the ball, "
                f"and {(photo_mask & beside_ball).sum()} observations of other objects"
            )
            cure = (
                f"the ball needs {LEAST_BALL_PIXELS} pixels, and the photo another object: "
                "check mask and pose of the ball in the overlay of `align`"
            )
            raise InputError(fault, key=f"known.illumination.{name}.chrome", cure=cure)
        world = photos[ball.photo].world_from_camera
        lights[name] = light_from_ball(pixels, rows[m][3:6], np.eye(3) if world is None else np.array(world))
        observations = observations.take(beside_ball)
    classes = {number(name): CLASSES.get(one.kind, one.kind) for name, one in declared.materials.items() if one.kind}
    exposures = tuple(sorted({photos[photo].illumination for photo in declared.exposure}))
    return observations, KnownValues(rows, classes, lights, exposures)


def _known_rows(declared: KnownSlice, observations: Observations) -> dict[str, Float[np.ndarray, "7"]]:
    """Return k_d, k_s and roughness of the known materials, NaN where unknown.

    Raises:
        InputError: If no observation shows a known material.
    """
    chrome = {ball.material for ball in declared.balls.values()}
    rows = {}
    for name, known in declared.materials.items():
        if not (observations.material == list(observations.materials).index(name)).any():
            cure = "check in the overlays of `align` that mask and mesh show it in the same pixels"
            raise InputError(f"no observation shows material '{name}'", key=f"known.materials.{name}", cure=cure)
        if known.diffuse is None:
            continue
        roughness = known.roughness or (ROUGHNESS[0] if name in chrome else np.nan)
        rows[name] = np.array([*known.diffuse, *(known.specular or (np.nan,) * 3), roughness])
    return rows
