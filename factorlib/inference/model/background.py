"""Prior on a light, given the surroundings that its photos show.

`factorlib.urm.background` says which radiance L arrives from the directions that a photo shows.  A cell is observed as

    b = log Σ_j w_j L_j / Σ_j w_j,     w_j = exp(λ(z · ω_j − 1)) Ω_j,     coverage c = Σ_j w_j / ∫ exp(λ(z · ω − 1)) dω,

with the cell's own lobe as the kernel, over the observed texels j of direction ω_j and solid angle Ω_j.  Surroundings
are neither diffuse nor where the ground plane says, and objects shade the ground below them.  Each cell therefore has
an error of its own, of standard deviation `DEVIATION`/√c, and all cells together are too bright or too dark by a factor
per channel, whose logarithms have the covariance T of `SCALE_DEVIATION` and `TINT_DEVIATION`.  Where objects contradict
a background, all its standard deviations are wider (`factorlib.inference.choices.model_selection`).  With A the columns
that select the cells of a channel, the error of b has the covariance D⁻¹ + A T Aᵀ and, by Woodbury, the precision R.
For u ~ N(0, Q⁻¹) that gives u ~ N(m, P⁻¹) with

    P = Q + R,     P m = R b,     R = D − D A (T⁻¹ + AᵀD A)⁻¹ AᵀD,     D = diag(c)/DEVIATION².                       (1)

Radiance of surroundings is absolute, so a background also tells the scale between reflectances and lights, within T.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve, cholesky

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.inference.model.lights import Light
from factorlib.light.lobes import lobe_energy
from factorlib.robust import TINY

DEVIATION = 0.4  # standard deviation of the log radiance of a cell that is observed whole
# Standard deviations of the factor that all cells of a light share: of the mean over channels of its logarithm, and of
# tints about it.  Two sets with backgrounds were relit by factors of 1.15, 1.11, 1.04 and 1.21, 1.16, 1.06 (RGB): in
# both sets in the same direction, so that the photos of a set have it in common, and a light has that of its set.
SCALE_DEVIATION = 0.115
TINT_DEVIATION = 0.06
SHARED_COVARIANCE = np.full((3, 3), SCALE_DEVIATION**2) + TINT_DEVIATION**2 * (np.eye(3) - 1 / 3)  # T
SHARPEST = 350.0  # largest λ of a kernel, about as wide as a texel
# Least share of the sphere that the background of a photo covers.  A long lens shows only what is straight behind the
# objects, such as black cloth or sky.  This says nothing of the light, but would fix the scale of reflectances.
LEAST_COVERAGE = 0.05
LEAST_RADIANCE = 1e-3  # least radiance of a cell, in units of the block


class Background(msgspec.Struct, frozen=True):
    """Radiance of the surroundings in the k directions that the photos of one light show.

    Attributes:
        direction: Unit vectors in the light's frame.
        radiance: Radiance in the unit of the block.
        solid_angle: Solid angle of each direction's texel.
        width: Factor on all standard deviations of its errors.
    """

    direction: Float[np.ndarray, "k 3"]
    radiance: Float[np.ndarray, "k 3"]
    solid_angle: Float[np.ndarray, " k"]
    width: float = 1.0

    @staticmethod
    def from_map(lat_long: Float[np.ndarray, "h w 3"], rotation: Float[np.ndarray, "3 3"], unit: float) -> Background:
        """Return the texels of a map that are not 0.

        Args:
            lat_long: Map of `factorlib.urm.background`, in the camera's y-up frame.
            rotation: Rotation from the camera's frame (OpenCV) to the light's.
            unit: Unit of the block.
        """
        height, width = lat_long.shape[:2]
        observed = lat_long.any(axis=-1)
        direction = lat_long_directions(height, width)[observed] @ YUP_FROM_CAMERA @ np.asarray(rotation).T
        solid_angle = np.broadcast_to(lat_long_solid_angles(height, width)[:, None], (height, width))[observed]
        return Background(direction, lat_long[observed] / unit, solid_angle)

    def observe(self, light: Light) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p 3"]]:
        """Return c and b of each cell; c is 0 for suns."""
        sharpness = np.minimum(light.sharpness, SHARPEST)
        kernel = np.exp(sharpness[:, None] * (light.axis @ self.direction.T - 1)) * self.solid_angle
        weight = kernel.sum(1)
        mean = kernel @ self.radiance / np.maximum(weight, TINY)[:, None]
        coverage = np.where(light.suns, 0.0, np.minimum(weight / lobe_energy(sharpness), 1))
        return coverage, np.log(np.maximum(mean, LEAST_RADIANCE))


def concatenate_backgrounds(backgrounds: list[Background]) -> Background | None:
    """Return the background of all photos that cover more than LEAST_COVERAGE; None if there is none."""
    wide = [background for background in backgrounds if background.solid_angle.sum() > LEAST_COVERAGE * 4 * np.pi]
    if not wide:
        return None
    names = "direction", "radiance", "solid_angle"
    direction, radiance, solid_angle = (np.concatenate([getattr(each, name) for each in wide]) for name in names)
    return Background(direction, radiance, solid_angle)


def condition_on_background(
    Q: Float[np.ndarray, "3p 3p"], background: Background, light: Light
) -> tuple[Float[np.ndarray, " 3p"], Float[np.ndarray, "3p 3p"], float]:
    """Return mean and precision of u given the background, and the precision's log determinant, by (1).

    Args:
        Q: Precision of u, channel by channel, of mean 0.
        background: Surroundings that the photos show.
        light: Cells and suns of the light.
    """
    coverage, log_radiance = background.observe(light)
    D = coverage / (background.width * DEVIATION) ** 2
    shared = np.linalg.inv(np.linalg.inv(background.width**2 * SHARED_COVARIANCE) + D.sum() * np.eye(3))
    R = np.diag(np.tile(D, 3)) - np.kron(shared, np.outer(D, D))
    P = Q + R
    factor = cholesky(P, lower=True, check_finite=False)
    mean = cho_solve((factor, True), R @ log_radiance.T.reshape(-1), check_finite=False)
    return mean, P, 2 * float(np.log(np.diag(factor)).sum())
