"""Conjugate gradients that say where they end before their tolerance."""

import logging

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg

log = logging.getLogger("factorlib.inference")
MOST_ITERATIONS = 300  # ten times as many as data/eames needs


def solve_by_gradients(
    system: LinearOperator | csr_array,
    target: Float[np.ndarray, " n"],
    diagonal: Float[np.ndarray, " n"],
    tolerance: float,
    start: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, " n"]:
    """Return the solution of a positive definite system; a warning says if it is not within the tolerance.

    Args:
        system: Matrix, or its product with a vector.
        target: Right-hand side.
        diagonal: Diagonal of the matrix, the preconditioner (Jacobi).
        tolerance: Largest residual, as a share of the right-hand side.
        start: First guess; None for 0.
    """
    inverse = diags_array(1 / diagonal)
    solution, status = cg(system, target, x0=start, rtol=tolerance, maxiter=MOST_ITERATIONS, M=inverse)
    if status:
        text = "conjugate gradients did not converge in %d iterations: the detail of %d unknowns is only approximate"
        log.warning(text, MOST_ITERATIONS, len(target))
    return solution
