"""Inverses by Cholesky factors against those of plain solves."""

import numpy as np
import pytest

from factorlib.solve.marginal import positive_definite_inverse


def test_inverse_and_determinant_are_those_of_numpy_and_exactly_symmetric():
    root = np.random.default_rng(0).normal(size=(60, 60))
    matrix = root @ root.T + np.eye(60)
    found = positive_definite_inverse(matrix)
    np.testing.assert_allclose(found.matrix, np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(matrix).logabsdet, rel=1e-12)
    assert (found.matrix == found.matrix.T).all()


@pytest.mark.parametrize("spoilt", [-1.0, np.nan])
def test_what_is_not_positive_definite_is_an_error(spoilt):
    matrix = np.eye(4)
    matrix[2, 2] = spoilt
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        positive_definite_inverse(matrix)
