"""metrics.json as types: what is written when there is a truth, and the reason when a part of it is missing.

Keys are stable; every number is finite.  A section that cannot be had is null and `reasons` says why, by section.

set          counts of photos, materials, illuminations and of the connected components of the observation matrix
resynthesis  always there: `factorlib.evaluate.resynthesis`
materials    `factorlib.evaluate.materials`
relighting   `factorlib.evaluate.relighting`
light        `factorlib.evaluate.lights`
normals      photo -> `factorlib.evaluate.geometry.NormalError`
poses        photo -> object -> `factorlib.evaluate.geometry.PoseError`

Wherever there are gauges: none, scalar_per_set, channel_per_photo (`factorlib.evaluate.gauge`).  PSNR in dB, linear
relative to the white of the truth and after the tone map; DSSIM after the tone map (`factorlib.evaluate.picture`).
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from factorlib.evaluate.geometry import NormalError, PoseError
from factorlib.evaluate.lights import LightErrors
from factorlib.evaluate.materials import MaterialErrors
from factorlib.evaluate.relighting import Relighting
from factorlib.evaluate.resynthesis import Resynthesis

NO_TRUTH = "the dataset names no truth"


class Counts(msgspec.Struct, frozen=True):
    photos: int
    materials: int
    illuminations: int
    components: int


class Metrics(msgspec.Struct, frozen=True):
    """Everything that `evaluate` says of a set."""

    set: Counts
    resynthesis: Resynthesis
    materials: MaterialErrors | None
    relighting: Relighting | None
    light: LightErrors | None
    normals: dict[str, NormalError] | None
    poses: dict[str, dict[str, PoseError]] | None
    reasons: dict[str, str]


SECTIONS = ("materials", "relighting", "light", "normals", "poses")
MISSING = {
    "materials": "the truth says nothing about materials that were seen",
    "relighting": "the truth lacks materials or lights",
    "light": "the truth names no illumination of this set",
    "normals": "the truth has no normals for these photos",
    "poses": "the truth has no poses of these objects",
}


def reasons_of(sections: dict[str, object], has_truth: bool) -> dict[str, str]:
    """Why each section that is None is.

    >>> reasons_of({"materials": None, "relighting": 1, "light": 1, "normals": 1, "poses": 1}, False)
    {'materials': 'the dataset names no truth'}
    """
    return {name: MISSING[name] if has_truth else NO_TRUTH for name in SECTIONS if not sections[name]}


def flattened(value: object, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number of nested plain containers with its dotted path, in order.

    >>> list(flattened({"a": {"b": [1, 2.5]}, "c": None, "d": "text"}))
    [('a.b.0', 1), ('a.b.1', 2.5)]
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flattened(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple):
        for k, inner in enumerate(value):
            yield from flattened(inner, f"{path}.{k}" if path else str(k))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, value
