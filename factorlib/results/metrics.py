"""metrics.json of `evaluate`: errors against the photos and against the truth, and why a part of them is missing.

Keys are stable; every number is finite.  A section that cannot be had is null and `reasons` says why, by section.

set          counts of photos, materials, illuminations and of the connected components of the observation matrix
resynthesis  always there: `factorlib.evaluate.resynthesis`
materials    `factorlib.evaluate.materials`
relighting   `factorlib.evaluate.relighting`
relit_set    `factorlib.evaluate.relighting`: the relit set score
light        `factorlib.evaluate.lights`
normals      photo -> `NormalError`; see `factorlib.evaluate.geometry`
poses        photo -> object -> `PoseError`
verdict      how far the result can be trusted, truth or not; null where no photo shows a material

Wherever there are gauges: none, scalar_per_set, channel_per_photo (`factorlib.evaluate.gauge`).  PSNR in dB, linear
relative to the white of the truth and after the tone map; DSSIM after the tone map (`factorlib.evaluate.picture`).
"""

from pathlib import Path
from typing import Generic, Literal, TypeVar

import msgspec

from factorlib.jsonfile import read_result
from factorlib.results.materials import Reflectance, Vec3


class Counts(msgspec.Struct, frozen=True):
    """The counts of the set; components: groups of photos that share no material."""

    photos: int
    materials: int
    illuminations: int
    components: int


class PictureError(msgspec.Struct, frozen=True):
    """psnr_linear_db and psnr_tonemapped_db in dB, higher is better; dssim in [0, 1], 0 is the same picture."""

    psnr_linear_db: float
    psnr_tonemapped_db: float
    dssim: float


Error = TypeVar("Error")


class Scored(msgspec.Struct, Generic[Error], frozen=True):
    """The error of an estimate, and what a null scores in its place."""

    estimate: Error
    null: Error


ScoredPicture = Scored[PictureError]


class PhotoErrors(msgspec.Struct, frozen=True):
    """pixels, unused (of these), clipped, invalid, uncovered: numbers of pixels.  exposure = 1 / white of the photo.

    gauges: gauge -> scores over all counted pixels; null where none counts.  materials: material -> gauge -> scores.
    """

    exposure: float
    pixels: int
    unused: int
    clipped: int
    invalid: int
    uncovered: int
    clipped_satisfied: float | None
    factor: dict[str, tuple[float, float, float]]
    gauges: dict[str, ScoredPicture] | None
    materials: dict[str, dict[str, ScoredPicture]]


class Resynthesis(msgspec.Struct, frozen=True):
    """mean: over photos; worst_*: the lowest PSNR of any photo in the gauge `none`; null where no pixel counts at all."""

    photos: dict[str, PhotoErrors]
    mean: dict[str, ScoredPicture] | None
    worst_psnr_linear_db: float | None
    worst_psnr_tonemapped_db: float | None


class MaterialError(msgspec.Struct, frozen=True):
    """roughness: |estimate − truth|; diffuse, specular: signed relative error of each channel, after the factor."""

    roughness: float
    diffuse: Vec3
    specular: Vec3


class ComparedMaterial(msgspec.Struct, frozen=True):
    """A material beside the truth; component: the connected component whose factor it has."""

    component: int
    truth: Reflectance
    estimate: Reflectance  # as solved, the factor not applied
    error: MaterialError
    null: MaterialError


class MaterialErrors(msgspec.Struct, frozen=True):
    """factor: of each component, per channel, on the estimate.  The means are over materials (and channels)."""

    factor: dict[str, Vec3]
    materials: dict[str, ComparedMaterial]
    mean_roughness: float
    mean_diffuse: float
    mean_specular: float
    worst_roughness: float
    worst_diffuse: float
    worst_specular: float
    null_mean_roughness: float
    null_mean_diffuse: float
    null_mean_specular: float


Kinds = dict[str, PictureError]  # kind -> error


class RelitBall(msgspec.Struct, frozen=True):
    """gauges: gauge -> kind -> error.  exposure = 1 / white of the true ball.  observed: seen in this light in a photo."""

    observed: bool
    exposure: float
    gauges: dict[str, Kinds]


class Relighting(msgspec.Struct, frozen=True):
    """balls: light -> material.  The means are over balls; mean_unobserved over pairs that no photo shows, null if none."""

    balls: dict[str, dict[str, RelitBall]]
    mean: dict[str, Kinds]
    mean_unobserved: dict[str, Kinds] | None


class RelitSet(msgspec.Struct, frozen=True):
    """The relit set score over all pairs of a recovered material and a recovered light, dB, higher is better, beside its null's.

    pairs: how many;  worst_material, worst_light: the pair that scores worst_psnr_db
    factor: per channel, times the recovered reflectances and divided out of the recovered lights
    """

    pairs: int
    mean_psnr_db: float
    worst_psnr_db: float
    null_mean_psnr_db: float
    worst_material: str
    worst_light: str
    factor: Vec3


class LightError(msgspec.Struct, frozen=True):
    """Fractions of the truth's root mean square, and degrees; 0 is perfect."""

    rmse: float
    rmse_scale_invariant: float
    rgb_angle_deg: float


ScoredLight = Scored[LightError]


class LightErrors(msgspec.Struct, frozen=True):
    """gauge -> view -> errors; the views are mirror, glossy, lambertian and map_all, map_mirrored, map_unmirrored.

    mean: over lights.  mirrored_fraction: of the sphere, by light; null where no observation is known.
    """

    lights: dict[str, dict[str, dict[str, ScoredLight]]]
    mean: dict[str, dict[str, ScoredLight]]
    mirrored_fraction: dict[str, float | None]


class AngleError(msgspec.Struct, frozen=True):
    """Degrees."""

    median_deg: float
    p90_deg: float


class NormalError(msgspec.Struct, frozen=True):
    """Errors of normals over the observed pixels; the null faces the camera everywhere."""

    pixels: int
    estimate: AngleError
    null: AngleError


class PoseError(msgspec.Struct, frozen=True):
    """rotation in degrees; translation as a fraction of the true distance; null is a random rotation's mean angle."""

    rotation_deg: float
    translation_relative: float
    null_rotation_deg: float


class Verdict(msgspec.Struct, frozen=True):
    """How far a result can be trusted, from what is known without truth (`factorlib.evaluate.verdict`).

    expected_relit_db, deviation_db: the relit set score that is expected, and how far scores of made sets lie from that
    reasons: what speaks against the result, the weightiest first;  next: what would help most
    terms: what each sign adds to the mean square error that is expected of shown balls
    """

    trust: Literal["good", "usable with care", "do not trust"]
    expected_relit_db: float
    deviation_db: float
    reasons: list[str]
    next: str
    terms: dict[str, float]


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
    relit_set: RelitSet | None = None
    verdict: Verdict | None = None


def read_metrics(path: str | Path) -> Metrics:
    """Raises InputError for a file that is none."""
    return read_result(path, Metrics, "evaluate")
