"""Grouping of equal rows; what merging does to observations is in test_urm.py and test_visibility.py."""

import numpy as np
import pytest

from factorlib.urm.cells import groups


@pytest.mark.parametrize("largest", [1, 7, 3 * 10**8], ids=["one value", "few", "too many for one number"])
def test_groups_are_those_of_unique_rows(largest):
    rng = np.random.default_rng(0)
    keys = rng.integers(-largest, largest, (500, 4))
    keys = np.vstack([keys, keys[::3]])[rng.permutation(667)]
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    found_first, found_group = groups(keys)
    np.testing.assert_array_equal(found_first, first)
    np.testing.assert_array_equal(found_group, group.reshape(-1))
