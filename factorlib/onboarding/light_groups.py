"""Kind of the light of photos around a thing: at rest, fixed to the camera, or one for each photo.

Patch p of the surface has in photo j the mean log radiance

    x_jp = a_p + c_j + f_j · φ(n) + e                                                                                (1)

with a_p the patch's own, c_j the exposure, and φ the spherical harmonics of degrees 1 and 2 at its normal: diffuse
surfaces reflect hardly any others (Ramamoorthi and Hanrahan 2001).  Under a light at rest f is 0, for a_p holds what
all photos have in common.  Where a thing turns before camera and light, f is common and n stands in the camera's frame.
Else each photo has its own f, and n stands in the world's.  Fits are robust (Student's t), with a eliminated.

The light is at rest unless own lights explain a standard deviation of `DIFFERENT` of x: 0.02 and 0.07 under one light
(a made jug in the sun, a real walk), 0.16 and 0.26 under others.  It is fixed to the camera if a common f there
explains `MOSTLY` of that variance.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, hstack

from factorlib.robust import robust_deviation

Kind = Literal["world", "camera", "photo"]
DIFFERENT = 0.11
MOSTLY = 0.75
PULL = 1e-3  # share of the observations by which f is pulled to 0: its common part is not determined
DEVIATIONS = 2.0  # residual, in robust deviations, at which an observation counts half
NOISE = 0.01  # least standard deviation of e
ITERATIONS = 8


def kind_of_light(
    log_radiance: Float[np.ndarray, "v p"], normal: Float[np.ndarray, "p 3"], rotations: Float[np.ndarray, "v 3 3"]
) -> tuple[Kind, float]:
    """Return the kind of light of photos, and the standard deviation of log radiance that own lights explain.

    Args:
        log_radiance: Mean log radiance of each patch in each photo; NaN where it does not show it.
        normal: Normals of the patches, in the world's frame.
        rotations: Rotation cam_from_world of each photo.
    """
    shared = np.isfinite(log_radiance).sum(0) > 1
    photo, patch = np.nonzero(np.isfinite(log_radiance) & shared)
    value = log_radiance[photo, patch]
    photos, rows = len(rotations), np.arange(len(value))
    exposure = csr_array((np.ones(len(value)), (rows, photo)), (len(value), photos))
    # columns of f: one set of each photo in the world's frame, or one set of all in the camera's
    own = harmonics(normal[patch])
    columns = 8 * photo[:, None] + np.arange(8)
    by_photo = csr_array((own.reshape(-1), (rows.repeat(8), columns.reshape(-1))), (len(value), 8 * photos))
    by_camera = csr_array(harmonics(np.einsum("nij,nj->ni", rotations[photo], normal[patch])))
    without, by_own, by_common = (
        _unexplained(csr_array(hstack([exposure, *f])), photos, patch, value) ** 2
        for f in ((), (by_photo,), (by_camera,))
    )
    explained = max(without - by_own, 0.0)
    if explained < DIFFERENT**2:
        return "world", explained**0.5
    return "camera" if without - by_common > MOSTLY * explained else "photo", explained**0.5


def harmonics(normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 8"]:
    """Return the real spherical harmonics of degrees 1 and 2, up to factors."""
    x, y, z = normal.T
    return np.column_stack([x, y, z, x * y, y * z, z * x, x**2 - y**2, 3 * z**2 - 1])


def _unexplained(
    design: csr_array, exposures: int, patch: Int[np.ndarray, " n"], value: Float[np.ndarray, " n"]
) -> float:
    """Return the robust standard deviation of e in (1).

    Args:
        design: Derivatives of x by c and f.
        exposures: Number of columns of c.
        patch: Patch of each observation.
        value: x.
    """
    n, unknowns = design.shape
    patches = csr_array((np.ones(n), (np.arange(n), patch)), (n, int(patch.max()) + 1))
    pull = PULL * n * np.r_[np.full(exposures, 1e-6), np.ones(unknowns - exposures)]
    weight = np.ones(n)
    for _ in range(ITERATIONS):
        # normal equations of (c, f), with a eliminated: S = DᵀWD − CᵀG⁻¹C, C = PᵀWD, G = PᵀWP
        weighted = design.multiply(weight[:, None]).tocsr()
        total = np.maximum(patches.T @ weight, 1e-12)
        coupling = (patches.T @ weighted).toarray()
        system = (design.T @ weighted).toarray() - coupling.T @ (coupling / total[:, None]) + np.diag(pull)
        means = patches.T @ (weight * value) / total
        solution = np.linalg.solve(system, weighted.T @ value - coupling.T @ means)
        own = means - coupling @ solution / total
        residual = value - design @ solution - own[patch]
        deviation = max(robust_deviation(residual), NOISE)
        weight = 1 / (1 + (residual / (DEVIATIONS * deviation)) ** 2)
    return deviation
