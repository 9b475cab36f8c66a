"""Values that travel: the same elements, bits and strides at the other end; large arrays once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorlib import parcel
from factorlib.parcel import Shelf, pack, unpack

RNG = np.random.default_rng


ARRAYS = {
    "rows": RNG(0).normal(size=(300, 40)),
    "columns": RNG(0).normal(size=(300, 40)).T,
    "columns, large": np.asfortranarray(RNG(0).normal(size=(300, 40))),
    "a few columns": RNG(0).normal(size=(300, 40))[:, 3:7],
    "backward": RNG(0).normal(size=(300, 40))[::-2, ::3],
    "repeated": np.broadcast_to(RNG(0).normal(size=40), (5000, 40)),
    "one": np.array(3.0),
    "none": np.zeros((0, 3)),
    "an axis of one": RNG(0).normal(size=(300, 40))[:, None, :],
    "words": np.array(["red", "wood"]),
    "zeros of both signs": np.array([0.0, -0.0] * 4000),
    "truths": RNG(0).random((300, 300)) < 0.001,
    "32 bits": RNG(0).normal(size=(300, 40)).astype(np.float32),
}


@pytest.mark.parametrize("kind", ARRAYS)
@pytest.mark.parametrize("shelved", [True, False])
def test_an_array_arrives_with_its_bits_and_strides(tmp_path, kind, shelved):
    sent = ARRAYS[kind]
    got = unpack(Shelf(tmp_path).pack([sent])[0] if shelved else pack(sent))
    assert (got.dtype, got.shape, got.tobytes()) == (sent.dtype, sent.shape, sent.tobytes())
    assert got.strides == sent.strides or sent.size == 0
    assert got.flags.writeable, "what was computed elsewhere is an array like any other"


@given(st.data())
def test_any_view_arrives_with_its_bits_and_strides(data):
    whole = RNG(0).normal(size=data.draw(st.tuples(*[st.integers(1, 5)] * 3)))
    steps = [slice(data.draw(st.integers(0, 2)), None, data.draw(st.sampled_from([1, 2, -1]))) for _ in range(3)]
    sent = whole[tuple(steps)].transpose(data.draw(st.permutations(range(3))))
    got = unpack(pack(sent))
    assert got.shape == sent.shape and got.tobytes() == sent.tobytes()
    assert got.strides == sent.strides or sent.size == 0


def test_sums_come_out_with_the_same_bits():
    """The order of a sum depends on the layout: this is what layouts are kept for."""
    sent = RNG(0).normal(size=(1000, 33)).astype(np.float32)[:, ::4]
    assert unpack(pack(sent)).sum(0).tobytes() == sent.sum(0).tobytes()
    assert np.ascontiguousarray(sent.T).sum(1).tobytes() != sent.sum(0).tobytes(), "another layout gives other bits"


def test_parts_of_one_array_are_sent_once_and_share_its_memory():
    whole = RNG(0).normal(size=(300, 300))
    parts = whole[:280, :280], whole[:280, 280:], whole[280:, 280:]
    packed = pack(parts)
    got = unpack(packed)
    assert len(packed) < 1.1 * whole.nbytes
    assert all(g.tobytes() == p.tobytes() and g.strides == p.strides for g, p in zip(got, parts, strict=True))
    assert got[0].base is not None and np.shares_memory(got[0].base, got[2].base if got[2].base is not None else got[2])


def test_what_is_sent_again_is_not_written_again(tmp_path):
    shelf, seen = Shelf(tmp_path), [RNG(k).normal(size=5000) for k in range(3)]
    first = shelf.pack([(one, 0) for one in seen])
    written = shelf.written
    again = shelf.pack([(one.copy(), 1) for one in seen])
    assert written == 3 * 40_000 == shelf.written and sum(map(len, again)) < 2000
    assert [unpack(data)[0].tobytes() for data in first + again] == [one.tobytes() for one in seen] * 2


def test_a_shelf_drops_what_is_not_used_any_more_and_sends_it_again_when_it_is(tmp_path):
    shelf, old, new = Shelf(tmp_path), RNG(0).normal(size=5000), RNG(1).normal(size=5000)
    shelf.pack([old])
    for _ in range(parcel.FORGOTTEN):
        shelf.pack([new])
    assert shelf.written == 80_000 and len(list(tmp_path.iterdir())) == 1
    assert unpack(shelf.pack([old])[0]).tobytes() == old.tobytes() and shelf.written == 120_000


def test_functions_that_no_module_has_travel_by_their_code():
    factor = RNG(0).normal(size=3)
    assert (unpack(pack(lambda x: factor * x))(2) == factor * 2).all()


def test_a_cut_file_of_a_shelf_is_an_error(tmp_path):
    (data,) = Shelf(tmp_path).pack([RNG(0).normal(size=5000)])
    file = next(tmp_path.iterdir())
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(OSError, match="cut at"):
        unpack(data)
