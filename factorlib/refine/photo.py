"""All objects of one photo, each refined in turn while the others stay: the one that shows most first."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from factorlib.align.camera import Camera, Pose
from factorlib.align.evidence import Evidence
from factorlib.align.raster import Caster
from factorlib.align.refine import FocalPrior
from factorlib.align.state import State, state_of
from factorlib.refine.choice import Settled, Standards, settled
from factorlib.refine.descent import moving_object
from factorlib.refine.pixels import Pixels, View
from factorlib.solve.unknowns import Materials


class Thing(msgspec.Struct, frozen=True):
    """An object: its pose as it was found, the pose that came second, whether it moves (a given pose does not), and whether its
    pixels tell the light while others move (those of a doubtful pose do not)."""

    caster: Caster
    evidence: Evidence
    pose: Pose
    runner_up: Pose | None = None
    moves: bool = True
    trusted: bool = True


class Scene(msgspec.Struct, frozen=True):
    """A photo: its camera, its objects, what is known of its focal length (moved only where there is one object), and the
    number of directions in which objects shadow (0: they do not)."""

    camera: Camera
    things: list[Thing]
    prior: FocalPrior
    shadows: int = 0


class Refined(msgspec.Struct, frozen=True):
    """An object's pose as it was and now, as states from which the camera follows too, and what decided (None: it was not tried)."""

    before: State
    after: State
    settled: Settled | None

    @property
    def moved(self) -> bool:
        return self.settled is not None and self.settled.chosen != "found"


def refined_photo(
    scene: Scene,
    pixels: Pixels | None,
    materials: Materials,
    operator,
    standards: Standards = Standards(),
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Refined]:
    """Every object, in order; `pixels` is None where the photo shows too few."""
    things, camera, poses = scene.things, scene.camera, [thing.pose for thing in scene.things]
    before = [state_of(thing.pose, camera, thing.caster) for thing in things]
    results = [Refined(state, state, None) for state in before]
    prior = scene.prior if len(things) == 1 else FocalPrior(camera.focal, 0.0)
    for done, k in enumerate(by_pixels(things)):
        report(done, len(things))
        if pixels is None or not things[k].moves or not things[k].evidence.inside.any():
            continue
        view = View(pixels, [thing.caster for thing in things], [j == k or thing.trusted for j, thing in enumerate(things)], scene.shadows)
        moving = moving_object(view, k, poses, camera, things[k].evidence, prior)
        rival = state_of(things[k].runner_up, camera, things[k].caster) if things[k].runner_up else None
        verdict = settled(moving, before[k], rival, materials, operator, pixels.cell, standards)
        if verdict is not None:
            results[k] = Refined(before[k], verdict.candidates[verdict.chosen].state, verdict)
        if results[k].moved:
            poses[k] = results[k].after.pose(things[k].caster)
    return results


def by_pixels(things: Sequence[Thing]) -> list[int]:
    """Their numbers, the one with most pixels first."""
    return sorted(range(len(things)), key=lambda k: (-int(things[k].evidence.inside.sum()), k))
