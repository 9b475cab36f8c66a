"""metrics.json of `evaluate`: errors against the photos and against the truth, and reasons for missing ones.

Keys are stable, and every number is finite.  A section that cannot be computed is null, and `reasons` says why, by
section.

set          counts of photos, materials, illuminations and connected components of the observation matrix
resynthesis  always present: `factorlib.evaluate.picture_errors`
held_out     predictions of held-out photos by a solve without them, likewise; null without any
views        held-out photo -> picture -> PSNR: of the predicted view, and of pictures that need no materials; null
             without any (`factorlib.evaluate.predicted_views`)
materials    `factorlib.evaluate.truth`
relighting   `factorlib.evaluate.relighting`
relit_set    the relit set score of `factorlib.evaluate.relighting`
light        `factorlib.evaluate.relighting`
normals      photo -> `NormalError`; see `factorlib.evaluate.truth`
albedo       `factorlib.evaluate.truth`
poses        photo -> object -> `PoseError`
verdict      trust in the result, with or without truth; null if no photo shows a material

Gauges are none, scalar_per_set and channel_per_photo (`factorlib.evaluate.comparison_gauge`).  PSNR is in dB, in linear
radiance relative to the truth's white and after the tone map.  DSSIM is after the tone map
(`factorlib.evaluate.picture_errors`).
"""

from pathlib import Path
from typing import Generic, Literal, TypeVar

import msgspec

from factorlib.jsonfile import read_result
from factorlib.results.materials import Reflectance, Vec3


class Counts(msgspec.Struct, frozen=True):
    """Numbers of photos, materials, illuminations and connected components of the set.

    Attributes:
        components: groups of photos that share no material
    """

    photos: int
    materials: int
    illuminations: int
    components: int


class PictureError(msgspec.Struct, frozen=True):
    """Errors of a picture against the true one.

    Attributes:
        psnr_linear_db: dB, higher is better
        psnr_tonemapped_db: dB, higher is better
        dssim: in [0, 1]; 0 is the same picture
    """

    psnr_linear_db: float
    psnr_tonemapped_db: float
    dssim: float


Error = TypeVar("Error")


class ErrorWithNull(msgspec.Struct, Generic[Error], frozen=True):
    """Error of an estimate, and error of a null, the trivial guess that it must beat."""

    estimate: Error
    null: Error


ScoredPicture = ErrorWithNull[PictureError]


class PhotoErrors(msgspec.Struct, frozen=True):
    """Errors of the re-synthesis of a photo.

    Attributes:
        exposure: 1 / white of the photo
        pixels: number of counted pixels
        unused: number of these that the solve did not use
        clipped: number of clipped pixels
        invalid: number of pixels left out by the mask or not finite
        uncovered: number of pixels in the mask that the mesh does not explain
        clipped_satisfied: fraction of clipped pixels whose re-synthesis reaches the clipped value
        factor: factor per channel, by gauge
        gauges: scores over all counted pixels, by gauge; null if there are none
        materials: scores by material and gauge
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


class ResynthesisErrors(msgspec.Struct, frozen=True):
    """Errors of the re-synthesis of all photos.

    Attributes:
        mean: mean over photos, by gauge
        worst_psnr_linear_db: lowest PSNR of any photo in the gauge `none`; null if no pixel counts
        worst_psnr_tonemapped_db: lowest PSNR of any photo in the gauge `none`; null if no pixel counts
    """

    photos: dict[str, PhotoErrors]
    mean: dict[str, ScoredPicture] | None
    worst_psnr_linear_db: float | None
    worst_psnr_tonemapped_db: float | None


class MaterialError(msgspec.Struct, frozen=True):
    """Errors of a material.

    Attributes:
        roughness: |estimate − truth|
        diffuse: signed relative error of each channel, after the factor
        specular: signed relative error of each channel, after the factor
    """

    roughness: float
    diffuse: Vec3
    specular: Vec3


class ComparedMaterial(msgspec.Struct, frozen=True):
    """A material with its truth.

    Attributes:
        component: connected component whose factor it has
        estimate: as solved, without the factor
    """

    component: int
    truth: Reflectance
    estimate: Reflectance
    error: MaterialError
    null: MaterialError


class MaterialScores(msgspec.Struct, frozen=True):
    """Errors of all materials.

    Attributes:
        factor: factor on the estimates of each component, per channel
        mean_roughness: mean over materials, as all means; those of colours are over channels too
    """

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
    """A ball of a recovered material in one light.

    Attributes:
        observed: True if a photo shows the material in this light
        exposure: 1 / white of the true ball
        gauges: errors by gauge and kind
    """

    observed: bool
    exposure: float
    gauges: dict[str, Kinds]


class Relighting(msgspec.Struct, frozen=True):
    """Errors of relit balls.

    Attributes:
        balls: by light and material
        mean: mean over balls, by gauge and kind
        mean_unobserved: mean over pairs that no photo shows; null if there are none
    """

    balls: dict[str, dict[str, RelitBall]]
    mean: dict[str, Kinds]
    mean_unobserved: dict[str, Kinds] | None


class RelitSet(msgspec.Struct, frozen=True):
    """The relit set score over all pairs of a recovered material and a recovered light, in dB; higher is better.

    Attributes:
        pairs: number of pairs
        null_mean_psnr_db: score of the null
        worst_material: material of the pair with worst_psnr_db
        worst_light: light of the pair with worst_psnr_db
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
    """Errors of a light, as fractions of the truth's root mean square and in degrees; 0 is perfect."""

    rmse: float
    rmse_scale_invariant: float
    rgb_angle_deg: float


ScoredLight = ErrorWithNull[LightError]


class LightErrors(msgspec.Struct, frozen=True):
    """Errors of lights, by gauge and view.

    The views are mirror, glossy, lambertian and map_all, map_mirrored, map_unmirrored.

    Attributes:
        lights: errors by light, gauge and view
        mean: mean over lights
        mirrored_fraction: share of the sphere that some pixel mirrors, by light; null if no observations are known
    """

    lights: dict[str, dict[str, dict[str, ScoredLight]]]
    mean: dict[str, dict[str, ScoredLight]]
    mirrored_fraction: dict[str, float | None]


class AngleError(msgspec.Struct, frozen=True):
    """Median and 90th percentile of angles, in degrees."""

    median_deg: float
    p90_deg: float


class NormalError(msgspec.Struct, frozen=True):
    """Errors of normals over the observed pixels; the null faces the camera everywhere."""

    pixels: int
    estimate: AngleError
    null: AngleError


class RelativeError(msgspec.Struct, frozen=True):
    """Median and 90th percentile of relative errors; 0 is perfect."""

    median: float
    p90: float


class AlbedoErrors(msgspec.Struct, frozen=True):
    """Errors of k_d over pixels and channels; the null is the material without its texture.

    Attributes:
        pixels: number of compared pixels
        factor: factor on the estimate per channel, for the whole set
        overall: errors over the pixels of all materials
        materials: errors by material
    """

    pixels: int
    factor: Vec3
    overall: ErrorWithNull[RelativeError]
    materials: dict[str, ErrorWithNull[RelativeError]]


class PoseError(msgspec.Struct, frozen=True):
    """Errors of a pose.

    Attributes:
        rotation_deg: angle in degrees
        translation_relative: distance over the true distance from the camera
        null_rotation_deg: mean angle of a random rotation
    """

    rotation_deg: float
    translation_relative: float
    null_rotation_deg: float


Trust = Literal["good", "usable with care", "do not trust"]


class Verdict(msgspec.Struct, frozen=True):
    """Trust in a result from what is known without truth (`factorlib.evaluate.verdict`).

    Attributes:
        expected_relit_db: expected relit set score
        deviation_db: deviation of the scores of made sets from the expected ones
        reasons: what limits the score, the largest term first
        next: the most helpful next step
        terms: terms of the expected mean square error of shown balls
    """

    trust: Trust
    expected_relit_db: float
    deviation_db: float
    reasons: list[str]
    next: str
    terms: dict[str, float]


class Metrics(msgspec.Struct, frozen=True):
    """Content of metrics.json."""

    set: Counts
    resynthesis: ResynthesisErrors
    materials: MaterialScores | None
    relighting: Relighting | None
    light: LightErrors | None
    normals: dict[str, NormalError] | None
    poses: dict[str, dict[str, PoseError]] | None
    reasons: dict[str, str]
    relit_set: RelitSet | None = None
    verdict: Verdict | None = None
    held_out: ResynthesisErrors | None = None
    views: dict[str, dict[str, float]] | None = None
    albedo: AlbedoErrors | None = None

    @property
    def photos(self) -> dict[str, PhotoErrors]:
        """Errors of all photos: re-synthesised, or else predicted."""
        return (self.held_out.photos if self.held_out else {}) | self.resynthesis.photos


def read_metrics(path: str | Path) -> Metrics:
    """Read metrics.json; InputError if the file has another form."""
    return read_result(path, Metrics, "evaluate")
