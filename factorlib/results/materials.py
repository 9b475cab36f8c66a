"""JSON files of `solve` and `export`: materials.json, exposures.json and uncertainty.json.

materials.json has reflectances with standard errors, their gauge, and the choices of the model.  exposures.json has the
factor of each photo on its light, per channel.  uncertainty.json has the standard errors and the residual level.
"""

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
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


def vec3(values: Iterable[float]) -> Vec3:
    """Return three numbers as plain floats."""
    x, y, z = map(float, values)
    return x, y, z


class Reflectance(msgspec.Struct, frozen=True):
    """Lambert k_d and GGX k_s per channel (linear Rec. 709), roughness in [0, 1] with α = roughness²."""

    diffuse: Channels
    specular: Channels
    roughness: Annotated[float, msgspec.Meta(ge=0, le=1)]

    @property
    def alpha(self) -> float:
        """GGX width α."""
        return self.roughness**2

    @property
    def total(self) -> float:
        """The sum max k_d + max k_s."""
        return max(self.diffuse) + max(self.specular)

    @property
    def mixture(self) -> tuple[float, Vec3, Vec3]:
        """The weight w of the specular part in a blend of two BSDFs, and their colours k_d/(1 − w) and k_s/w.

        A part of weight 0 is black.
        """
        weight = max(self.specular) / self.total if self.total > 0 else 0.0
        diffuse = vec3(value / (1 - weight) if weight < 1 else 0.0 for value in self.diffuse)
        return weight, diffuse, vec3(value / weight if weight > 0 else 0.0 for value in self.specular)


class StandardErrors(msgspec.Struct, frozen=True):
    """Standard errors of a reflectance, in the gauge that the file's `gauge.stderr` names."""

    diffuse: Channels
    specular: Channels
    roughness: AtLeast0


class Kind(msgspec.Struct, frozen=True):
    """Most probable class of a material (dielectric, metal or fabric) by its specular part, and its probability."""

    name: str
    probability: Annotated[float, msgspec.Meta(ge=0, le=1)]


class PriorShares(msgspec.Struct, frozen=True):
    """Shares of a reflectance that come from the prior on materials, 0 (observations alone) to 1."""

    diffuse: Share
    specular: Share
    roughness: Share


class SolvedMaterial(Reflectance, frozen=True):
    """A solved material with its standard errors.

    Attributes:
        alpha: α = roughness², for other programs
        kind: class of the material, if the solver has classes
        given: parts that were known beforehand, with standard errors of 0
        prior_share: shares that come from the prior, if the solver has one
        textures: meshes on which an albedo texture multiplies `diffuse`, in the materials that `export` writes
    """

    alpha: AtLeast0
    stderr: StandardErrors
    kind: Kind | UnsetType = UNSET
    given: list[str] | UnsetType = UNSET
    prior_share: PriorShares | UnsetType = UNSET
    textures: list[str] | UnsetType = UNSET

    @property
    def reflectance(self) -> Reflectance:
        """The reflectance without its standard errors."""
        return Reflectance(self.diffuse, self.specular, self.roughness)


class PaintRange(msgspec.Struct, frozen=True):
    """Brightest paint of a material, as it was estimated.

    Attributes:
        brightest: k_d times the factor plus max k_s, which all but 2 % of the painted surface is below
        above: share of the painted surface where that sum exceeds 1
    """

    brightest: AtLeast0
    above: Share


class Gauge(msgspec.Struct, frozen=True):
    """Rule that fixed the factor per channel that the observations leave free.

    Attributes:
        component: index of each material's connected component, which has its own factor
        stderr: gauge of the standard errors
        export_factor: factor of `export` on all reflectances
        export_rule: reason of that factor
        paint: paint that reflects more than it receives, by material, before the factor
    """

    rule: str = ""
    component: dict[str, int] = {}
    stderr: str = ""
    export_factor: Positive | UnsetType = UNSET
    export_rule: str | UnsetType = UNSET
    paint: dict[str, PaintRange] | UnsetType = UNSET


class Tone(msgspec.Struct, frozen=True):
    """Tone curve of a photo (`factorlib.images.tone`).

    Attributes:
        pivot: radiance that the curve leaves unchanged
    """

    exponent: Positive
    pivot: Positive


class Decision(msgspec.Struct, frozen=True):
    """Decision to include an optional part of the model or not, with its evidence; None for a measure not taken.

    Attributes:
        held_out_loss_with: geometric mean over lights of their mean losses with it; of held-out observations, but of
            all for a sun
        held_out_loss_without: the same without it
        margin: increase of the loss without it, in standard errors
        log_bayes_factor: log marginal likelihood with it, less that without it
        correlation: of shadows on the ground, predicted by the objects alone and observed
        width: factor on the errors of a background, which is more than 1 where the objects contradict it
        share: share of the light that a sun holds, or would hold
        warmth: logarithm of red over blue of a sun, less that of the rest of the light
    """

    accepted: bool = msgspec.field(name="kept")
    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None
    margin: float | None = None
    log_bayes_factor: float | None = None
    correlation: float | None = None
    width: float | None = None
    share: float | None = None
    warmth: float | None = None


class WarmStart(msgspec.Struct, frozen=True):
    """Materials and illuminations taken over from an earlier solution."""

    materials: list[str]
    illuminations: list[str]


class FitStatus(msgspec.Struct, frozen=True):
    """End of an iterative fit.

    Attributes:
        outcome: converged: the last step lowered the objective by less than its tolerance; limit: the allowed steps
            ended first; failed: no step lowered it
        steps: number of steps
    """

    outcome: Literal["converged", "limit", "failed"]
    steps: int


class Model(msgspec.Struct, frozen=True):
    """Choices of the model, the evidence for them, and the status of the fits.

    Attributes:
        lobes: number of lobes, or cells, by illumination
        held_out_loss: loss after each report of the paper's solver
        light_prior: True if lights are cells with the prior of natural light
        self_shadowing_chosen_by: held-out loss of each model that was tried, and the margin in standard errors
        interreflection_chosen_by: log Bayes factor of the model with it; empty if not tried
        splitting_chosen_by: decision of each splitting of cells
        suns_chosen_by: decision on a sun, by illumination
        background_chosen_by: decision on the surroundings that photos show, by illumination
        ground_chosen_by: decision on the shadows on the ground, by illumination
        tone: curves of the photos that have one
        tone_chosen_by: decision on tone curves, by illumination
        distance: distance of each light that is not at infinity, in RMS distances of a photo's points from their middle
        distance_chosen_by: decision on the distance, by illumination
        materials_fit: status of the last fit of materials and lights together; None of the paper's solver
        light_fits: status of the last fit of each light with the materials given, by illumination
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
    background_chosen_by: dict[str, Decision] = {}
    ground_chosen_by: dict[str, Decision] = {}
    tone: dict[str, Tone] = {}
    tone_chosen_by: dict[str, Decision] = {}
    distance: dict[str, Positive] = {}
    distance_chosen_by: dict[str, Decision] = {}
    materials_fit: FitStatus | None = None
    light_fits: dict[str, FitStatus] = {}
    started_from: WarmStart | UnsetType = UNSET

    def curvature(self, illumination: str) -> float:
        """Return one over the distance of a light; 0 for a light at infinity."""
        return 1 / self.distance[illumination] if illumination in self.distance else 0.0


class MaterialTable(msgspec.Struct, frozen=True):
    """Content of materials.json."""

    materials: dict[str, SolvedMaterial]
    gauge: Gauge = Gauge()
    model: Model = Model()


class Misfit(msgspec.Struct, frozen=True):
    """Shares of a photo that the solution leaves unexplained, and that are clipped.

    Attributes:
        unexplained: share of the photo's shading that is not explained (`factorlib.inference.model.misfit`)
        clipped: share of the photo's values that are clipped
    """

    unexplained: AtLeast0
    clipped: AtLeast0


class Uncertainty(msgspec.Struct, frozen=True):
    """Content of uncertainty.json.

    Attributes:
        residual_sigma: deviation of the residuals in units of the noise model
        materials: standard errors by material
        gauge: gauge of the standard errors
        unexplained: share of the shading of all photos that the solution does not explain
        photos: misfit of each photo
    """

    residual_sigma: AtLeast0
    materials: dict[str, StandardErrors]
    gauge: str
    unexplained: AtLeast0 = 0.0
    photos: dict[str, Misfit] = {}


def attach_errors(
    reflectance: Reflectance,
    stderr: StandardErrors,
    kind: Kind | UnsetType = UNSET,
    given_fields: list[str] | UnsetType = UNSET,
) -> SolvedMaterial:
    """Combine a reflectance with its standard errors.

    Args:
        reflectance: the reflectance
        stderr: its standard errors
        kind: class of the material
        given_fields: parts of the reflectance that were known beforehand
    """
    rows = reflectance.diffuse, reflectance.specular, reflectance.roughness
    return SolvedMaterial(*rows, reflectance.roughness**2, stderr, kind, given_fields)


def read_uncertainty(path: str | Path) -> Uncertainty:
    """Read uncertainty.json; InputError if the file has another form."""
    return read_result(path, Uncertainty, "solve")


def read_materials(path: str | Path, cure: str = "") -> MaterialTable:
    """Read materials.json; InputError if the file has another form."""
    return read_result(path, MaterialTable, "solve", cure)


def reflectances(table: MaterialTable) -> dict[str, Reflectance]:
    """Return the reflectances by name, without standard errors."""
    return {name: material.reflectance for name, material in table.materials.items()}


def select_materials(table: MaterialTable, names: Sequence[str], path: str | Path) -> list[SolvedMaterial]:
    """Return the materials called `names`, in that order.

    Args:
        table: the materials
        names: names to look up
        path: the table's file, for errors

    Raises:
        InputError: The table lacks a material.
    """
    for name in names:
        if name not in table.materials:
            raise InputError(
                f"the materials are not those of the data set: {name!r} is missing",
                file=path,
                key="materials",
                cure="run the stage `solve` again",
            )
    return [table.materials[name] for name in names]


def read_exposures(path: str | Path, cure: str = "") -> dict[str, Channels]:
    """Read exposures.json: positive factors by photo; InputError if the file has another form."""
    exposures = read_result(path, dict[str, Channels], "solve", cure)
    for photo, channels in exposures.items():
        if min(channels) <= 0:
            raise InputError(
                "an exposure is not positive", file=path, key=photo, cure=cure or "run the stage `solve` again"
            )
    return exposures
