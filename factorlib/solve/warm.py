"""Where the rounds start when an earlier solution is given: what has a name there is used, the rest is found from it.

    known   materials by their name, lights by their illumination's; the radiance unit of a block is taken out of its light,
            photos new to a light get the exposure that explains their median radiance
    new     what a known light shows, or known materials lie in, is found first, again and again: a light by insertion and descent with
            the materials fixed, a material by the search over all roughnesses with the lights fixed
    left    what no chain of photos links to anything known starts from mean radiances, as all does from nothing

Earlier materials that no photo linked stand in gauges of their own.  A photo that links them gives the factor per channel
between them: how much brighter the ones are, in its light, than the others predict.

A light that explains its photos worse than one broad lobe does (it was taken again, or turned, or in other units) is not
known but new.  Only the rounds' start and what is decided before them are changed: nothing pulls toward the earlier answer.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

from factorlib.model.blocks import Block
from factorlib.model.bounds import ROUGHNESS, SHARPNESS, TONE
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.results.solution import Earlier
from factorlib.solve.descent import Descent, descend
from factorlib.solve.insertion import blurred, pruned
from factorlib.solve.options import Bundle
from factorlib.solve.roughness import materials_of_best_roughness
from factorlib.solve.rounds import Start, from_nothing, robust, with_new_lobes
from factorlib.solve.start import starting_light
from factorlib.solve.weights import fitted_illumination

log = logging.getLogger("factorlib.solve")
AT_ONCE = 2  # times as many lobes as a round inserts, where materials need not be found with them
GUESSED_DIFFUSE, GUESSED_SPECULAR = 0.3, 0.1  # of a new material, before it is searched for


class Known(msgspec.Struct, frozen=True):
    """What an earlier solution says of a problem's materials and blocks.

    component: number of each known material's own gauge, −1 where a material is new;  lights: None where one is new
    """

    materials: Materials
    component: Int[np.ndarray, " m"]
    lights: list[Light | None]


def from_earlier(earlier: Earlier, names: Sequence[str], specular: str) -> Start:
    """The start of a problem whose materials are called `names`; `specular` as of the bundle: `on` decides nothing."""
    model = earlier.table.model.specular
    decided = np.array([name in model and name in earlier.table.materials and specular == "auto" for name in names])
    lambertian = np.array([not model.get(name, True) for name in names]) & decided
    return Start(partial(_point, earlier=earlier, names=list(names)), decided, lambertian, converged=True)


def known_of(earlier: Earlier, names: Sequence[str], blocks: Sequence[Block]) -> Known:
    """What the earlier solution says of materials `names` and of the blocks, matched by name."""
    rows, component = np.full((len(names), 7), 0.5), np.full(len(names), -1)
    for m, name in enumerate(names):
        if found := earlier.table.materials.get(name):
            rows[m] = [*found.diffuse, *found.specular, found.roughness]
            component[m] = earlier.table.gauge.component[name]
    return Known(Materials.of_vector(rows.reshape(-1)), component, [_light(earlier, block) for block in blocks])


def _light(earlier: Earlier, block: Block) -> Light | None:
    """In the block's radiance unit; NaN is the log exposure of a photo that was not there.  None without lobes or photos."""
    lobes = earlier.lights.get(block.name)
    exposure = np.array([np.log(np.mean(earlier.exposures.get(photo, (np.nan,) * 3))) for photo in block.photos])
    if not lobes or np.isnan(exposure).all() or earlier.table.model.light_prior:  # a lattice is no start for a few lobes
        return None
    axis = lobes.axis / np.linalg.norm(lobes.axis, axis=1, keepdims=True)
    tone = [earlier.table.model.tone[photo].exponent for photo in block.photos if photo in earlier.table.model.tone]
    log_tone = np.log(np.clip(tone, *TONE)) if len(tone) == len(block.photos) else np.zeros(0)
    return Light(axis, np.log(np.clip(lobes.sharpness, *SHARPNESS)), lobes.weight / block.unit, exposure, log_tone)


def _point(problem: JointProblem, bundle: Bundle, *, earlier: Earlier, names: list[str]) -> Point:
    return Propagation(problem, known_of(earlier, names, problem.blocks), bundle).point()


class Propagation:
    """Materials and lights while they become known; what is known only grows."""

    def __init__(self, problem: JointProblem, known: Known, bundle: Bundle):
        self.problem, self.bundle, self.blocks = problem, bundle, problem.blocks
        self.materials, self.component = known.materials, known.component.copy()
        self.lights: list[Light | None] = [None] * len(self.blocks)
        for i, light in enumerate(known.lights):
            if light is not None and self._known_rows(i).any():
                self.lights[i] = self._checked(i, light)

    def point(self) -> Point:
        """All materials and lights, in one gauge where they are linked."""
        self._one_gauge()
        while self._lights_of_materials() | self._materials_of_lights():
            self._one_gauge()
        return self._rest()

    def _known_rows(self, i: int) -> Bool[np.ndarray, " n"]:
        """Observations of block i whose materials are known, in the one gauge that most of them have."""
        component = self.component[self.blocks[i].material]
        return (component == _most(component)) & (component >= 0)

    def _seen_in(self, block: Block, light: Light) -> Illumination:
        return Illumination(block, light, self.materials, self.problem.operator)

    def _checked(self, i: int, light: Light) -> Light | None:
        """The light with every photo's exposure and its weights fitted again; None where one broad lobe explains more."""
        shown = self.blocks[i].take(self._known_rows(i))
        light = with_exposures(self._seen_in(shown, light))
        best, least = (
            fitted_illumination(self._seen_in(shown, one), self.problem.loss) for one in (light, starting_light(shown, self.materials))
        )
        if best.equations.loss < least.equations.loss:
            return best.light
        log.warning("illumination '%s' starts anew: what the earlier solution says of it explains less than one broad lobe", shown.name)
        return None

    def _lights_of_materials(self) -> bool:
        """Find the new lights that show known materials; whether there were any."""
        new = [i for i, light in enumerate(self.lights) if light is None and self._known_rows(i).any()]
        shown = [self.blocks[i].take(self._known_rows(i)) for i in new]
        fit = partial(fitted_light, materials=self.materials, bundle=self.bundle)
        alone = [JointProblem([block], self.problem.operator, self.problem.loss) for block in shown]
        for i, light in zip(new, self.problem.spread(fit, alone), strict=True):
            self.lights[i] = light
        return bool(new)

    def _materials_of_lights(self) -> bool:
        """Find the new materials that known lights show; whether there were any."""
        lit = [i for i, light in enumerate(self.lights) if light is not None]
        blocks = [self.blocks[i] for i in lit]
        new = [m for m in np.flatnonzero(self.component < 0) if any((block.material == m).any() for block in blocks)]
        if not new:
            return False
        self.materials = self.materials.replaced(_guess(len(self.materials)), new)
        found = materials_of_best_roughness(self.problem.restricted(lit), Point(self.materials, [self.lights[i] for i in lit]))
        self.materials = self.materials.replaced(found, new)
        for m in new:
            shows = next(i for i in lit if (self.blocks[i].material == m).any())
            self.component[m] = _most(self.component[self.blocks[shows].material])
        return True

    def _one_gauge(self) -> None:
        """Materials of different gauges that one light shows come into the gauge that most of its observations have."""
        for i, (block, light) in enumerate(zip(self.blocks, self.lights, strict=True)):
            if light is None:
                continue
            main = _most(self.component[block.material])
            for other in sorted(set(self.component[block.material].tolist()) - {-1, main}):
                rows = block.take(self.component[block.material] == other)
                self._rescale(other, brighter(self._seen_in(rows, light)), main, i)

    def _rescale(self, other: int, factor: Float[np.ndarray, "3"], main: int, keep: int) -> None:
        members = np.flatnonzero(self.component == other)
        for i, light in enumerate(self.lights):
            if light is not None and i != keep and _most(self.component[self.blocks[i].material]) == other:
                self.lights[i] = msgspec.structs.replace(light, weight=light.weight / factor)
        diffuse, specular = self.materials.diffuse.copy(), self.materials.specular.copy()
        diffuse[members] *= factor
        specular[members] *= factor
        self.materials = Materials(diffuse, specular, self.materials.roughness)
        self.component[members] = main

    def _rest(self) -> Point:
        """The point, with what is not linked to anything known from mean radiances."""
        start = from_nothing(len(self.materials)).point(self.problem, self.bundle)
        materials = self.materials.replaced(start.materials, np.flatnonzero(self.component < 0))
        return Point(materials, [light if known is None else known for known, light in zip(self.lights, start.lights, strict=True)])


def fitted_light(problem: JointProblem, materials: Materials, bundle: Bundle) -> Light:
    """The light of a problem of one block, found by rounds of insertion and descent as long as they gain; the materials are known."""
    light, best, least = starting_light(problem.blocks[0], materials), None, np.inf
    every = np.ones(7 * len(materials), bool)
    bundle = msgspec.structs.replace(bundle, insert=AT_ONCE * bundle.insert)
    for number in range(bundle.rounds):
        start = Point(materials, [light])
        fitting = problem.with_loss(robust(problem, start))
        current = with_new_lobes(fitting, start, bundle, number)
        current = descend(fitting, current, Descent(bundle.iterations, bundle.tolerance), fixed=every)
        light = blurred(pruned(current.point.lights[0]), materials.sharpest)
        held_out = problem.held_out_loss(Point(materials, [light]))
        gained, least, best = least - held_out, min(least, held_out), light if held_out < least else best
        if gained < bundle.least_gain * held_out or len(light) >= bundle.lobes:
            break
    return best


def with_exposures(illumination: Illumination) -> Light:
    """Its light with the exposures that were not known (NaN), and the first photo's moved into the weights."""
    light, block = illumination.light, illumination.block
    exposure = light.log_exposure
    guess = msgspec.structs.replace(light, log_exposure=np.where(np.isnan(exposure), 0.0, exposure))
    for k in np.flatnonzero(np.isnan(exposure)):
        rows = block.photo == k
        if rows.any():
            of_photo = msgspec.structs.replace(illumination, block=block.take(rows), light=guess)
            guess.log_exposure[k] = np.log(brighter(of_photo)).mean()
    first = guess.log_exposure[0]
    return msgspec.structs.replace(light, weight=light.weight * np.exp(first), log_exposure=guess.log_exposure - first)


def brighter(illumination: Illumination) -> Float[np.ndarray, "3"]:
    """The factor per channel by which observations are brighter than predicted (medians)."""
    predicted = np.median(illumination.radiance(), axis=0)
    return np.maximum(np.median(illumination.block.radiance, axis=0), 1e-6) / np.maximum(predicted, 1e-6)


def _guess(count: int) -> Materials:
    """Grey materials in the middle of the roughnesses, which the search that follows replaces."""
    row = [*([GUESSED_DIFFUSE] * 3), *([GUESSED_SPECULAR] * 3), np.sqrt(ROUGHNESS[0] * ROUGHNESS[1])]
    return Materials.of_vector(np.tile(row, count))


def _most(component: Int[np.ndarray, " n"]) -> int:
    """The gauge that most observations have, of those in any; −1 where none is."""
    of_known = component[component >= 0]
    return int(np.bincount(of_known).argmax()) if len(of_known) else -1
