"""Symmetric positive definite matrices by their Cholesky factor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dpotri


class Inverse(NamedTuple):
    """The inverse of a matrix, and the log of the matrix's determinant."""

    matrix: Float[np.ndarray, "n n"]
    log_determinant: float


def positive_definite_inverse(matrix: Float[np.ndarray, "n n"]) -> Inverse:
    """Of a symmetric positive definite matrix, by LAPACK's potrf and potri: half of what solving with the identity takes.

    Raises LinAlgError where it is not positive definite, or not a number.

    >>> positive_definite_inverse(np.array([[4.0, 0.0], [0.0, 0.25]])).matrix.tolist()
    [[0.25, 0.0], [0.0, 4.0]]
    """
    factor, failed = dpotrf(matrix, lower=1, clean=1)
    logarithm = np.nan if failed else 2 * float(np.log(np.diag(factor)).sum())
    if not np.isfinite(logarithm):
        raise LinAlgError(f"a matrix of {len(matrix)} rows is not positive definite, or not finite")
    inverse, _ = dpotri(factor, lower=1)
    lower = np.tril(inverse, -1)
    return Inverse(lower + lower.T + np.diag(np.diag(inverse)), logarithm)
