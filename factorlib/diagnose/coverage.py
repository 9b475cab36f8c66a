"""Which directions of a light of few lobes the data constrain: the standard error of its radiance there.

Let a be the whitened response of a lobe of unit weight at direction d, about `WIDTH_DEG` wide, and J the Jacobian by all unknowns
other than the lobes (materials, exposures, tone curves).  With the light of other directions known, the information about the weight
of this lobe is the Schur complement

    i_d = aᵀa − aᵀJ (JᵀJ)⁻¹ Jᵀa = ‖a‖² − ‖Qᵀa‖²,       Q an orthonormal basis of J's columns,                  (1)

and 1/√i_d is the standard error of the radiance in direction d, averaged over that width.  It is large where no observation reflects
d toward the camera, and where only Lambertian materials do.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.light.lobes import lobe_integral
from factorlib.model.illumination import Illumination
from factorlib.model.lights import UnitLobes
from factorlib.model.loss import Loss
from factorlib.solve.few_lobes.jacobian import linearise, places_of
from factorlib.solve.few_lobes.unknowns import unknowns

PROBE_SHARPNESS = 100.0  # of the lobes whose weight's error is computed
WIDTH_DEG = float(np.degrees(np.sqrt(2 / PROBE_SHARPNESS)))  # where such a lobe has fallen to 1/e: 8°
ROWS, LARGEST = 32, 1000.0
SAMPLE = 1000  # observations used; the information is scaled to all of them


def relative_standard_errors(illumination: Illumination, loss: Loss, sigma: float) -> Float[np.ndarray, "h w 3"]:
    """Standard errors over the light's mean radiance, as a small lat-long map in the frame of the exported ones, at most LARGEST.

    loss: that the answer minimises;  sigma: standard deviation of the residuals in units of the noise model
    """
    light = illumination.light
    directions = lat_long_directions(ROWS, 2 * ROWS) @ YUP_FROM_CAMERA  # of the block's frame
    errors = light_standard_errors(illumination, loss, directions.reshape(-1, 3), sigma)
    mean = lobe_integral(light.sharpness) @ light.weight / (4 * np.pi)
    return np.minimum(errors / np.maximum(mean, 1e-30), LARGEST).reshape(ROWS, 2 * ROWS, 3)


def light_standard_errors(
    illumination: Illumination, loss: Loss, directions: Float[np.ndarray, "d 3"], sigma: float
) -> Float[np.ndarray, "d 3"]:
    """Standard error of the light's radiance in unit `directions` of the block's frame, in the block's unit.

    loss: that the answer minimises;  sigma: standard deviation of the residuals in units of the noise model
    Infinite where no observation sees a direction at all.
    """
    count = len(illumination.block)
    rows = np.sort(np.random.default_rng(0).permutation(count)[:SAMPLE])
    sample = msgspec.structs.replace(illumination, block=illumination.block.take(rows).with_none_held_out())
    atoms = sample.atoms(np.arange(len(rows)), UnitLobes(directions, np.full(len(directions), PROBE_SHARPNESS)))
    information = [_information(atoms[c], jacobian) for c, jacobian in enumerate(_jacobians(sample, loss))]
    with np.errstate(divide="ignore"):
        return sigma / np.sqrt(np.stack(information, 1) * count / len(rows))


def _information(atoms: Float[np.ndarray, "n d"], jacobian: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " d"]:
    """Equation (1)."""
    u, values, _ = np.linalg.svd(jacobian, full_matrices=False)
    basis = u[:, values > 1e-9 * max(float(values.max(initial=0.0)), 1e-300)]
    return np.maximum(np.sum(atoms**2, 0) - np.sum((basis.T @ atoms) ** 2, 0), 0.0)


def _jacobians(illumination: Illumination, loss: Loss) -> list[Float[np.ndarray, "n k"]]:
    """J of each channel, in the order of the block's rows, without robust weights, for `Illumination.atoms` has none either.

    Materials that the block does not show have no columns.
    """
    light, every = illumination.light, places_of(illumination)
    first = len(every) - unknowns(light)
    whole = [np.zeros((len(illumination.block), len(every))) for _ in range(3)]
    for part in linearise(illumination, msgspec.structs.replace(loss, robust_scale=1e6)):
        whole[part.channel][part.rows, np.searchsorted(every, part.places)] = part.jacobian.numpy()
    others = np.r_[0:first, first + 6 * len(light) : len(every)]
    return [jacobian[:, others] for jacobian in whole]
