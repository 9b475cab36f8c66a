"""Which directions of a light the data constrain: the standard error of its radiance there.

Let a be the whitened response of a lobe of unit weight at direction d, about `WIDTH_DEG` wide, and J the Jacobian of what is
solved for besides the lobes (materials, exposures, tones).  What the data say about the light's weight there, all that J could
imitate left out and the light of other directions given, is the Schur complement

    i_d = aᵀa − aᵀJ (JᵀJ)⁻¹ Jᵀa = ‖a‖² − ‖Qᵀa‖²,       Q an orthonormal basis of J's columns,                  (1)

and 1/√i_d is the standard error of the radiance in direction d, averaged over that width.  It is large where no
observation reflects d toward the camera, and in what only matte materials see.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.light.lobes import lobe_integral
from factorlib.solve.insertion import whitened_atoms
from factorlib.solve.normal_equations import Loss, responses, whitened_rows
from factorlib.solve.problem import Block, of_rows
from factorlib.solve.unknowns import Light, Materials

SHARPNESS = 100.0  # of the lobes that are asked about
WIDTH_DEG = float(np.degrees(np.sqrt(2 / SHARPNESS)))  # where such a lobe has fallen to 1/e: 8°
ROWS, LARGEST = 32, 1000.0
SAMPLE = 1000  # observations that tell, on behalf of all


def relative_standard_errors(
    block: Block, light: Light, materials: Materials, operator, loss: Loss, sigma: float
) -> Float[np.ndarray, "h w 3"]:
    """Standard errors over the light's mean radiance, as a small lat-long map in the frame of the exported ones, at most LARGEST."""
    directions = lat_long_directions(ROWS, 2 * ROWS) @ YUP_FROM_CAMERA  # of the block's frame
    errors = light_standard_errors(block, light, materials, operator, loss, directions.reshape(-1, 3), sigma)
    mean = lobe_integral(light.sharpness) @ light.weight / (4 * np.pi)
    return np.minimum(errors / np.maximum(mean, 1e-30), LARGEST).reshape(ROWS, 2 * ROWS, 3)


def light_standard_errors(
    block: Block, light: Light, materials: Materials, operator, loss: Loss, directions: Float[np.ndarray, "d 3"], sigma: float
) -> Float[np.ndarray, "d 3"]:
    """Standard error of the light's radiance in unit `directions` of the block's frame, in the block's unit.

    sigma: standard deviation of the residuals in units of the noise model
    Infinite where no observation sees a direction at all.
    """
    rows = np.sort(np.random.default_rng(0).permutation(len(block))[:SAMPLE])
    seen = msgspec.structs.replace(of_rows(block, rows), held_out=np.zeros(len(rows), bool))
    atoms = whitened_atoms(seen, np.arange(len(rows)), materials, operator, directions, np.full(len(directions), SHARPNESS), light)
    told = [_information(atoms[c], jacobian) for c, jacobian in enumerate(_jacobians(seen, light, materials, operator, loss))]
    with np.errstate(divide="ignore"):
        return sigma / np.sqrt(np.stack(told, 1) * len(block) / len(rows))


def _information(atoms: Float[np.ndarray, "n d"], jacobian: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "d"]:
    """Equation (1)."""
    u, values, _ = np.linalg.svd(jacobian, full_matrices=False)
    basis = u[:, values > 1e-9 * max(float(values.max(initial=0.0)), 1e-300)]
    return np.maximum(np.sum(atoms**2, 0) - np.sum((basis.T @ atoms) ** 2, 0), 0.0)


def _jacobians(block: Block, light: Light, materials: Materials, operator, loss: Loss) -> list[Float[np.ndarray, "n k"]]:
    """Of each channel by all but the lobes, in the order of the block's rows; robust weights left out, since a lobe's atoms have none."""
    unknowns = 7 * len(materials) + light.unknowns
    whole = [np.zeros((len(block), unknowns)) for _ in range(3)]
    plain = msgspec.structs.replace(loss, robust_scale=1e6)
    for some in responses(block, light, materials, operator):
        for c, channel in enumerate(whitened_rows(block, light, materials, some, plain)):
            whole[c][some.rows, channel.places] = channel.jacobian.numpy()
    first = 7 * len(materials)
    others = np.r_[0:first, first + 6 * len(light) : unknowns]
    return [jacobian[:, others] for jacobian in whole]
