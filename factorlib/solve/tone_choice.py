"""Whether the photos of a light have a tone curve: where held-out observations are explained much better with one.

The problem is brought to rest.  An exponent for each photo is let loose where one Gauss-Newton step of everything then promises a gain
from it: the problem comes to rest once more, with and without, by as many iterations, and the lights whose own held-out loss falls
by `LEAST_GAIN` of itself keep their curves.  So large a gain, because an exponent also takes up some of what the rest of the model
has wrong, normals and reflections between objects; where it runs toward its bounds that is all it does, and it is not believed.
A light that has curves already, from an earlier solution, keeps them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.solve.descent import Descent, Solution, descend, evaluated
from factorlib.solve.held_out import Judge
from factorlib.solve.problem import Block
from factorlib.solve.step import damped_step
from factorlib.solve.tone import is_wild
from factorlib.solve.unknowns import Light

PROMISED = 0.05  # of the fitted loss, below which no curve is tried
LEAST_GAIN = 0.2  # of its own held-out loss, that a light's curves must be worth
ITERATIONS = 6
DAMPING = 1e-3


class Tone(msgspec.Struct, frozen=True):
    """What decided about the photos of a light: their held-out loss with and without tone curves, None where none was tried."""

    kept: bool
    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None


def rested(blocks: Sequence[Block], at: Solution, lights: Sequence[Light], operator, loss, map_: Callable) -> Solution:
    """With other lights, and some iterations later."""
    at = evaluated(blocks, at.materials, lights, operator, loss, map_)
    return descend(blocks, at, operator, loss, Descent(ITERATIONS), map_)


def toned_where_it_pays(
    blocks: Sequence[Block], start: Solution, operator, loss, losses: Judge, map_: Callable
) -> tuple[Solution, list[Tone]]:
    """The solution with the tone curves that it needs, and the evidence for every light.

    start: at rest
    """
    had = np.array([len(light.log_tone) > 0 for light in start.lights])
    if promised_gain(blocks, start, operator, loss, map_) < PROMISED:
        return start, [Tone(bool(has)) for has in had]
    without, found = (rested(blocks, start, lights, operator, loss, map_) for lights in (start.lights, loosened(start.lights, ~had)))
    with_, without_, before = (_means(losses(blocks, s)) for s in (found, without, start))
    without_ = np.minimum(without_, before)  # a lobe that grew in a gap of what is fitted says nothing for curves
    kept = (with_ < (1 - LEAST_GAIN) * without_) & ~had
    if kept.any():
        settled = rested(blocks, found, found.lights, operator, loss, map_)
        kept &= ~np.array([is_wild(light) for light in settled.lights])
    chosen = without if not kept.any() else found if (kept | had).all() else rested(blocks, start, loosened(start.lights, kept), operator, loss, map_)
    evidence = zip((kept | had).tolist(), with_.tolist(), without_.tolist(), had, strict=True)
    return chosen, [Tone(True) if has else Tone(*decided) for *decided, has in evidence]


def promised_gain(blocks: Sequence[Block], at: Solution, operator, loss, map_: Callable) -> float:
    """The share of the loss that one step of everything gains more with tone curves for all than without."""
    none = np.array([len(light.log_tone) == 0 for light in at.lights])
    loose = evaluated(blocks, at.materials, loosened(at.lights, none), operator, loss, map_)
    steps = [damped_step(s.systems, s.materials, s.lights, DAMPING).promised for s in (at, loose)]
    return (steps[1] - steps[0]) / max(at.loss, 1e-300)


def loosened(lights: Sequence[Light], which: Bool[np.ndarray, "k"]) -> list[Light]:
    """The lights, those of `which` with a curve for each photo, a straight one."""
    return [_straight(light) if one else light for light, one in zip(lights, which, strict=True)]


def _means(losses: Sequence[Float[np.ndarray, "n"]]) -> Float[np.ndarray, "k"]:
    """Of each light's observations, 0 for none."""
    return np.array([of_light.mean() if len(of_light) else 0.0 for of_light in losses])


def _straight(light: Light) -> Light:
    return msgspec.structs.replace(light, log_tone=np.zeros_like(light.log_exposure))
