"""Exposures by EXIF: only between photos of one light, and only where all of them say theirs."""

import msgspec
import numpy as np

from factorlib.urm.exposure import at_one_exposure, relative_exposures
from factorlib.urm.merge import merge
from factorlib.urm.observations import concatenate, read_observations, write_observations
from tests.urm.test_urm import observations


def photo(name, illumination, exposure):
    return msgspec.structs.replace(observations(name, illumination), exposures=(exposure,))


def test_photos_of_one_light_are_brought_to_the_exposure_of_its_first():
    seen = concatenate([photo("c", "room", 8.0), photo("a", "room", 2.0), photo("b", "garden", 5.0)])
    relative = relative_exposures(seen)
    assert relative == {"a": 1.0, "b": 1.0, "c": 4.0}
    same = at_one_exposure(seen, relative)
    of_c = seen.photo == seen.photos.index("c")
    np.testing.assert_allclose(same.radiance[of_c], seen.radiance[of_c] / 4)
    np.testing.assert_array_equal(same.radiance[~of_c], seen.radiance[~of_c])


def test_one_photo_that_does_not_say_leaves_the_light_as_it_is():
    seen = concatenate([photo("a", "room", 2.0), photo("b", "room", None), photo("c", "room", 4.0)])
    relative = relative_exposures(seen)
    assert set(relative.values()) == {1.0}
    assert at_one_exposure(seen, relative) is seen


def test_exposures_pass_through_files_and_merging(tmp_path):
    seen = photo("a", "room", 2.0)
    write_observations(tmp_path / "a.parquet", seen)
    assert read_observations(tmp_path / "a.parquet").exposures == (2.0,) == merge(seen, 5.0).exposures
    unknown, silent = photo("a", "room", None), observations("a", "room")
    for name, part in (("b", unknown), ("c", msgspec.structs.replace(silent, exposures=()))):
        write_observations(tmp_path / f"{name}.parquet", part)
    assert (tmp_path / "b.parquet").read_bytes() == (tmp_path / "c.parquet").read_bytes(), (
        "what is unknown leaves no trace"
    )
