"""Declaration of a study: its size, its cases, its settings and its claims.

Nothing here imports science, for plans are made of it.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec

NAMES = ("brick", "leaf", "lacquer", "chalk", "gold")  # the materials of every world
SEVEN = (*NAMES, "tile", "bronze")  # the materials of worlds of objects
Entry = tuple[int, int]  # a material and a light


# ── cases ────────────────────────────────────────────────────────────────────────────────────────────────────────────


class Objects(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bodies in place of spheres, and the errors of the mesh and the pose that the solve gets of each.

    pixels:      the largest number of observations of an entry
    turned_deg:  rotation about a random axis through the body's middle, degrees
    shifted:     shift in a random direction of the image, as a share of the mesh's diameter
    larger:      how much larger the mesh is, as a share of its size
    triangles:   triangles of the mesh that stands for the body; None: all of its 20,000
    refined:     whether every pose is first fitted to the outline of its mask, from the perturbed pose
    """

    pixels: int
    turned_deg: float = 0.0
    shifted: float = 0.0
    larger: float = 0.0
    triangles: int | None = None
    refined: bool = False


class Case(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One set of observations, solved once and compared with the truth of the world that its seed names.

    entries:       observed entries of the matrix of materials × lights
    size:          pixels across a sphere
    solve:         parameters of the stage `solve` that differ from their defaults
    normal_deg:    normals are turned by |N(0, normal_deg)| degrees toward random sides
    wrong_labels:  share of the pixels whose label names another material of the same photo
    facets:        faces that an object shows instead of a sphere; None: a sphere
    noise:         of each radiance, as a share of it
    objects:       bodies in place of spheres
    """

    seed: int
    entries: tuple[Entry, ...]
    size: int
    solve: dict[str, Any] = {}
    normal_deg: float = 0.0
    wrong_labels: float = 0.0
    facets: int | None = None
    noise: float = 0.01
    objects: Objects | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all materials of the world, in the order of their numbers."""
        return SEVEN if self.objects else NAMES

    @property
    def materials(self) -> list[int]:
        """The numbers of the observed materials, in order."""
        return sorted({m for m, _ in self.entries})

    @property
    def material_names(self) -> list[str]:
        """The names of the observed materials, in the order of their numbers in the observations."""
        return [self.names[m] for m in self.materials]

    @property
    def lights(self) -> list[int]:
        """The numbers of the observed lights, in order."""
        return sorted({li for _, li in self.entries})

    def names_in(self, light: int) -> list[str]:
        """Return the names of the materials that are observed in a light."""
        return [self.names[m] for m, li in self.entries if li == light]


class Comparison(Case, frozen=True, forbid_unknown_fields=True):
    """Photos of all methods, `size` pixels across, and the method that predicts others from them."""

    method: Literal["ours", "projective", "grey"] = "ours"


class World(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Seeds of worlds, the number of lights of each, and rows and samples of their maps."""

    seeds: tuple[int, ...]
    lights: int
    rows: int
    spp: int


class Score(msgspec.Struct, frozen=True):
    """The value of each measure of a case, and what a guess scores that knows mean colours alone (`nulls`)."""

    values: dict[str, float]
    nulls: dict[str, float] = {}

    def __or__(self, other: "Score") -> "Score":
        """Return the measures of both scores together."""
        return Score(self.values | other.values, self.nulls | other.nulls)


def light_name(light: int) -> str:
    """Return the name of an illumination, and of the photo that is in it."""
    return f"light{light}"


def case_name(setting: str, seed: int) -> str:
    """Return the name of a case's files.

    >>> case_name("3x3", 0)
    '3x3-seed0'
    """
    return f"{setting}-seed{seed}"


def full_matrix(materials: int, lights: int) -> list[Entry]:
    """Return the entries (material, light) of the full matrix.

    >>> full_matrix(1, 2)
    [(0, 0), (0, 1)]
    """
    return [(m, li) for m in range(materials) for li in range(lights)]


# ── scales and settings ──────────────────────────────────────────────────────────────────────────────────────────────


class Setting(msgspec.Struct, frozen=True):
    """One value of what a study varies.

    name:   a word of a-z, 0-9 and -, part of file names;  label: as tables write it
    case:   the case of a seed; what the study's first step is handed
    """

    name: str
    label: str
    case: Callable[[int], Any]


class Scale(msgspec.Struct, frozen=True):
    """Size of a study: at most `largest` materials and lights; `side` of each where something else is varied."""

    name: Literal["full", "quick"]
    seeds: tuple[int, ...]
    largest: int
    side: int
    size: int
    solve: dict[str, Any]
    light_rows: int = 64
    light_spp: int = 8

    @property
    def quick(self) -> bool:
        """True for the quick scale, which concludes nothing."""
        return self.name == "quick"

    def case(self, seed: int, entries: Sequence[Entry], **fields: Any) -> Case:
        """Return a case of this size with further `fields` of it.

        The scale's parameters of the solve are the joint solver's.
        """
        solve = fields.get("solve", {})
        if solve.get("solver", "joint") == "joint":
            solve = self.solve | solve
        return Case(seed, tuple(sorted(entries)), self.size, **fields | {"solve": solve})

    def setting(self, name: str, label: str, entries: Sequence[Entry] | None = None, **fields: Any) -> Setting:
        """Return a setting of equal entries for all seeds; None: of `side` materials in as many lights."""
        entries = full_matrix(self.side, self.side) if entries is None else entries
        return Setting(name, label, lambda seed: self.case(seed, entries, **fields))

    def matrix(self, materials: int, lights: int) -> Setting:
        """Return the setting of all entries of so many materials in so many lights."""
        return self.setting(f"{materials}x{lights}", f"{materials} × {lights}", full_matrix(materials, lights))

    def object_setting(
        self, name: str, label: str, entries: Sequence[Entry], solve: Any = None, **fields: Any
    ) -> Setting:
        """Return a setting of bodies, about as many observations of each as a sphere has; `fields` of `Objects`."""
        return self.setting(
            name, label, entries, solve=solve or {}, objects=Objects(round(0.77 * self.size**2), **fields)
        )


SMALL = {"cells": 24, "splittings": 0, "observations": 100}  # a solve that takes seconds and shows that a study runs
FULL = Scale("full", seeds=(0, 1, 2, 3, 4), largest=len(NAMES), side=3, size=32, solve={"splittings": 0})
QUICK = Scale("quick", seeds=(0,), largest=3, side=2, size=16, solve=SMALL, light_rows=32, light_spp=8)


# ── claims ───────────────────────────────────────────────────────────────────────────────────────────────────────────

# One side of a comparison: a setting; ("guess", setting): what a guess that knows mean colours alone scores in it; or
# ("rise", start, end, per): how much the measure rises from one setting to another, for each of the `per`
# units between them.
Side = str | tuple


class Claim(msgspec.Struct, frozen=True):
    """A comparison that a full study makes: the measure, or its rise, is lower on the side `lower` than on `higher`.

    words: the claim as a sentence's subject;  paper: whether the paper says so, rather than this project
    """

    measure: str
    lower: Side
    higher: Side
    words: str
    paper: bool = True


def project_claim(measure: str, lower: Side, higher: Side, words: str) -> Claim:
    """Return a claim of this project, which the paper does not make."""
    return Claim(measure, lower, higher, words, paper=False)


def settings_of(side: Side) -> list[str]:
    """Return the names of the settings of one side of a claim."""
    return [side] if isinstance(side, str) else list(side[1:3])


class Study(msgspec.Struct, frozen=True, kw_only=True):
    """Study: what it varies and what it measures.

    paper:     the paper's conclusion;  varied: what is varied, with its unit
    measures:  those of the page, the first the main one
    claims:    what a full study tests
    steps:     stages of studies/run/pipeline.yaml in `studies.steps`, the last one scores
    lights:    lights that each of its worlds has beyond those of the scale
    sets:      rendered data sets that its cases are photos of, as facts of the slice `sets`
    """

    name: str
    title: str
    question: str
    paper: str
    varied: str
    measures: tuple[str, ...]
    settings: Callable[[Scale], list[Setting]]
    claims: tuple[Claim, ...] = ()
    steps: tuple[str, ...] = ("worlds", "solve", "score")
    lights: int = 0
    sets: Callable[[Scale], dict[str, Any]] = lambda scale: {}

    def worlds(self, scale: Scale) -> World:
        """Return the worlds that its cases show, equal for most studies of a scale, so that they are made once."""
        return World(scale.seeds, scale.largest + self.lights, scale.light_rows, scale.light_spp)

    def cases(self, scale: Scale) -> dict[str, Any]:
        """Return all cases by name: settings in order, each with all seeds."""
        return {case_name(s.name, n): s.case(n) for s in self.settings(scale) for n in scale.seeds}
