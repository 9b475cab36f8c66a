"""All objects of one photo, each refined in turn while the others stay: the one that shows most first."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from factorlib.align.refine import FocalPrior
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State, state_of
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster
from factorlib.refine.choice import Settled, Standards, settled
from factorlib.refine.descent import moving_object
from factorlib.refine.light import Surfaces
from factorlib.refine.pixels import Pixels, View


class PosedObject(msgspec.Struct, frozen=True):
    """An object and its pose as it was found.

    runner_up  the pose that came second
    moves      whether the pose may change; one that was given may not
    trusted    whether the object's pixels are used for the light while other objects move; those of a doubtful pose are not
    """

    caster: Caster
    silhouette: Silhouette
    pose: Pose
    runner_up: Pose | None = None
    moves: bool = True
    trusted: bool = True


class Scene(msgspec.Struct, frozen=True):
    """A photo: its camera, its objects, what is known of its focal length (moved only where there is one object), and the
    number of directions in which objects shadow (0: they do not)."""

    camera: Camera
    objects: list[PosedObject]
    prior: FocalPrior
    shadows: int = 0


class Refined(msgspec.Struct, frozen=True):
    """An object's pose before and after, as states, which hold the focal length too; `settled` is None where no other was tried."""

    before: State
    after: State
    settled: Settled | None

    @property
    def moved(self) -> bool:
        """Whether another pose than the one found is used."""
        return self.settled is not None and self.settled.chosen != "found"


def refined_photo(
    scene: Scene,
    pixels: Pixels | None,
    surfaces: Surfaces,
    standards: Standards = Standards(),
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Refined]:
    """Every object, in order; `pixels` is None where the photo shows too few."""
    objects, camera, poses = scene.objects, scene.camera, [one.pose for one in scene.objects]
    before = [state_of(one.pose, camera, one.caster) for one in objects]
    results = [Refined(state, state, None) for state in before]
    prior = scene.prior if len(objects) == 1 else FocalPrior(camera.focal, 0.0)
    by_pixels = sorted(range(len(objects)), key=lambda k: (-int(objects[k].silhouette.inside.sum()), k))
    for done, k in enumerate(by_pixels):
        report(done, len(objects))
        own = objects[k]
        if pixels is None or not own.moves or not own.silhouette.inside.any():
            continue
        trusted = [j == k or one.trusted for j, one in enumerate(objects)]
        view = View(pixels, [one.caster for one in objects], trusted, scene.shadows)
        moving = moving_object(view, k, camera, own.silhouette, prior, poses, surfaces)
        rival = state_of(own.runner_up, camera, own.caster) if own.runner_up else None
        verdict = settled(moving, before[k], rival, pixels.cell, standards)
        if verdict is not None:
            results[k] = Refined(before[k], verdict.candidates[verdict.chosen].state, verdict)
        if results[k].moved:
            poses[k] = results[k].after.pose(own.caster)
    return results
