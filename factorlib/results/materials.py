"""JSON of `solve` and `export`: materials.json has reflectances with standard errors, their gauge, and what was decided of the model;
exposures.json what each photo's light is multiplied by, per channel; uncertainty.json the standard errors and the residual level."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, UnsetType

from factorlib.errors import InputError
from factorlib.jsonfile import read_result

Vec3 = tuple[float, float, float]
AtLeast0 = Annotated[float, msgspec.Meta(ge=0)]
Channels = tuple[AtLeast0, AtLeast0, AtLeast0]  # linear Rec. 709
Positive = Annotated[float, msgspec.Meta(gt=0)]


def vec3(values: Iterable[float]) -> Vec3:
    """Three numbers as plain floats."""
    x, y, z = map(float, values)
    return x, y, z


class Reflectance(msgspec.Struct, frozen=True):
    """Lambert k_d and GGX k_s per channel (linear Rec. 709), roughness in [0, 1] with α = roughness²."""

    diffuse: Channels
    specular: Channels
    roughness: Annotated[float, msgspec.Meta(ge=0, le=1)]

    @property
    def alpha(self) -> float:
        """α of GGX."""
        return self.roughness**2

    @property
    def total(self) -> float:
        """max k_d + max k_s."""
        return max(self.diffuse) + max(self.specular)


class StandardErrors(msgspec.Struct, frozen=True):
    """The standard errors of a reflectance, in the gauge that the file's `gauge.stderr` names."""

    diffuse: Channels
    specular: Channels
    roughness: AtLeast0


class Kind(msgspec.Struct, frozen=True):
    """The likeliest class of a material, dielectric, metal or fabric, by its specular part, and the probability of it."""

    name: str
    probability: Annotated[float, msgspec.Meta(ge=0, le=1)]


class Solved(Reflectance, frozen=True):
    """A solved material; alpha, α = roughness², stands in the file for other programs; kind: where the solver has classes.

    given: the parts that were known beforehand, whose standard errors are 0
    """

    alpha: AtLeast0
    stderr: StandardErrors
    kind: Kind | UnsetType = UNSET
    given: list[str] | UnsetType = UNSET

    @property
    def reflectance(self) -> Reflectance:
        """The reflectance without its standard errors."""
        return Reflectance(self.diffuse, self.specular, self.roughness)


class Gauge(msgspec.Struct, frozen=True):
    """Which rule settled the factor per channel that the observations leave free.

    component: number of each material's connected component, which has a factor of its own;  stderr: the gauge of standard errors
    export_factor, export_rule: what `export` multiplied all reflectances by, and why
    """

    rule: str = ""
    component: dict[str, int] = {}
    stderr: str = ""
    export_factor: Positive | UnsetType = UNSET
    export_rule: str | UnsetType = UNSET


class Tone(msgspec.Struct, frozen=True):
    """The tone curve of a photo (`factorlib.images.tone`); pivot is the radiance that it leaves as it is."""

    exponent: Positive
    pivot: Positive


class Decision(msgspec.Struct, frozen=True):
    """Whether a part of the model was kept, and the mean held-out loss with and without it; None for what was not tried.

    margin: by how many standard errors the loss is higher without it
    """

    kept: bool
    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None
    margin: float | None = None


class Started(msgspec.Struct, frozen=True):
    """What was taken over from an earlier solution."""

    materials: list[str]
    illuminations: list[str]


class Model(msgspec.Struct, frozen=True):
    """What was decided of the model, and by what.

    lobes:           number of lobes, or cells, by illumination
    held_out_loss:   after each report of the paper's solver
    light_prior:     whether lights are cells that follow the statistics of natural light
    self_shadowing_chosen_by, interreflection_chosen_by: the held-out loss of each model that was tried, and the margin in standard errors
    splitting_chosen_by: of each time that cells were split
    suns_chosen_by: of a sun in each illumination
    tone:            curves of the photos that have one;  tone_chosen_by: by illumination
    distance:        of lights that are not infinitely far away, in RMS distances of a photo's points from their middle;
                     distance_chosen_by: by illumination
    """

    solver: Literal["joint", "paper"] = "joint"
    lobes: dict[str, int] = {}
    lobes_chosen_by: str = ""
    held_out_loss: list[float] = []
    self_shadowing: bool = False
    self_shadowing_chosen_by: dict[str, float] = {}
    interreflection: bool = False
    interreflection_chosen_by: dict[str, float] = {}
    light_prior: bool = False
    splitting_chosen_by: list[Decision] = []
    suns_chosen_by: dict[str, Decision] = {}
    tone: dict[str, Tone] = {}
    tone_chosen_by: dict[str, Decision] = {}
    distance: dict[str, Positive] = {}
    distance_chosen_by: dict[str, Decision] = {}
    started_from: Started | UnsetType = UNSET

    def curvature(self, illumination: str) -> float:
        """One over the distance of a light; 0 where it is infinitely far away."""
        return 1 / self.distance[illumination] if illumination in self.distance else 0.0


class MaterialTable(msgspec.Struct, frozen=True):
    """The whole of materials.json."""

    materials: dict[str, Solved]
    gauge: Gauge = Gauge()
    model: Model = Model()


class Misfit(msgspec.Struct, frozen=True):
    """How a photo is explained: the share of its shading that is not (`factorlib.inference.misfit`), and of its values that are clipped."""

    unexplained: AtLeast0
    clipped: AtLeast0


class Uncertainty(msgspec.Struct, frozen=True):
    """residual_sigma: deviation of the residuals in units of the noise model;  materials: by name;  gauge: of the standard errors.

    unexplained: share of the shading of all photos that the answer does not explain;  photos: misfit of each
    """

    residual_sigma: AtLeast0
    materials: dict[str, StandardErrors]
    gauge: str
    unexplained: AtLeast0 = 0.0
    photos: dict[str, Misfit] = {}


def solved(
    reflectance: Reflectance,
    stderr: StandardErrors,
    kind: Kind | UnsetType = UNSET,
    given: list[str] | UnsetType = UNSET,
) -> Solved:
    """A reflectance with its standard errors, α, kind and the parts of it that were known."""
    rows = reflectance.diffuse, reflectance.specular, reflectance.roughness
    return Solved(*rows, reflectance.roughness**2, stderr, kind, given)


def read_uncertainty(path: str | Path) -> Uncertainty:
    """Raises InputError for a file that is none."""
    return read_result(path, Uncertainty, "solve")


def read_materials(path: str | Path, cure: str = "") -> MaterialTable:
    """Raises InputError for a file that is no table of materials."""
    return read_result(path, MaterialTable, "solve", cure)


def reflectances(table: MaterialTable) -> dict[str, Reflectance]:
    """Return the reflectances by name, without standard errors."""
    return {name: material.reflectance for name, material in table.materials.items()}


def in_order(table: MaterialTable, names: Sequence[str], path: str | Path) -> list[Solved]:
    """The materials called `names`; InputError where one is missing in the table, which was read from `path`."""
    for name in names:
        if name not in table.materials:
            found = f"not the materials of this set: {name!r} is missing"
            raise InputError(found, file=path, cure="run the stage `solve` again")
    return [table.materials[name] for name in names]


def read_exposures(path: str | Path, cure: str = "") -> dict[str, Channels]:
    """Factors by photo, all positive; raises InputError for a file that is none."""
    exposures = read_result(path, dict[str, Channels], "solve", cure)
    for photo, channels in exposures.items():
        if min(channels) <= 0:
            cure = cure or "run the stage `solve` again"
            raise InputError("an exposure is not a positive number", file=path, key=photo, cure=cure)
    return exposures
