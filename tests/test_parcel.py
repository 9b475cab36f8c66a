"""Values that travel: the same elements, bits and strides at the other end; large arrays once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorlib import parcel
from factorlib.parcel import Shelf, pack, unpack

RNG = np.random.default_rng
ROWS = RNG(0).normal(size=(300, 40))
ARRAYS = {
    "rows": ROWS,
    "columns": ROWS.T,
    "columns, large": np.asfortranarray(ROWS),
    "a few columns": ROWS[:, 3:7],
    "backward": ROWS[::-2, ::3],
    "repeated": np.broadcast_to(ROWS[0], (5000, 40)),
    "one": np.array(3.0),
    "none": np.zeros((0, 3)),
    "an axis of one": ROWS[:, None, :],
    "words": np.array(["red", "wood"]),
    "zeros of both signs": np.array([0.0, -0.0] * 4000),
    "truths": RNG(0).random((300, 300)) < 0.001,
    "32 bits": ROWS.astype(np.float32),
}


def assert_same(there, sent):
    assert (there.dtype, there.shape, there.tobytes()) == (sent.dtype, sent.shape, sent.tobytes())
    assert there.flags.writeable, "what was computed elsewhere is an array like any other"
    for one, other, size in zip(there.strides, sent.strides, sent.shape):
        assert one == other or size == 1 or sent.size == 0, "an axis of one is never walked along"


@pytest.mark.parametrize("kind", ARRAYS)
def test_an_array_arrives_with_its_bits_and_strides(tmp_path, kind):
    sent = ARRAYS[kind]
    shelved = Shelf(tmp_path).pack([sent])[0]
    for data in (shelved, pack(sent)):
        assert_same(unpack(data), sent)
    assert len(shelved) < sent.nbytes / 2 or sent.nbytes < parcel.LEAST, "the shelf has what is large"


@given(st.data())
def test_any_view_arrives_with_its_bits_and_strides(data):
    whole = RNG(0).normal(size=data.draw(st.tuples(*[st.integers(1, 5)] * 3)))
    steps = [slice(data.draw(st.integers(0, 2)), None, data.draw(st.sampled_from([1, 2, -1]))) for _ in range(3)]
    sent = whole[tuple(steps)].transpose(data.draw(st.permutations(range(3))))
    assert_same(unpack(pack(sent)), sent)


def test_what_is_sent_again_is_not_written_again_until_it_was_not_used_for_long(tmp_path):
    shelf, arrays = Shelf(tmp_path), [RNG(k).normal(size=5000) for k in range(3)]
    first = shelf.pack([(one, 0) for one in arrays])
    again = shelf.pack([(one.copy(), 1) for one in arrays])
    assert shelf.written == 3 * 40_000 and sum(map(len, again)) < 2000
    assert [unpack(data)[0].tobytes() for data in first + again] == [one.tobytes() for one in arrays] * 2
    other = RNG(3).normal(size=5000)
    for _ in range(parcel.FORGOTTEN):
        shelf.pack([other])
    assert shelf.written == 4 * 40_000 and len(list(tmp_path.iterdir())) == 1
    assert unpack(shelf.pack(arrays)[0]).tobytes() == arrays[0].tobytes() and shelf.written == 7 * 40_000


def test_functions_that_no_module_has_travel_by_their_code():
    factor = RNG(0).normal(size=3)
    assert (unpack(pack(lambda x: factor * x))(2) == factor * 2).all()


def test_a_cut_file_of_a_shelf_is_an_error(tmp_path):
    (data,) = Shelf(tmp_path).pack([RNG(0).normal(size=5000)])
    file = next(tmp_path.iterdir())
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(OSError, match="cut at"):
        unpack(data)
