"""Never a NaN, never a silent failure: an answer within its bound, or a message that says why there is none."""

import logging
from functools import cache

import msgspec
import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.jsonfile import read_json
from factorlib.model.illumination import material_slices
from factorlib.model.materials import Point
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.stage import Inputs, silent
from factorlib.urm.observations import write_observations
from stages import solve as stage
from studies.scenes.hard_cases import (
    BOUNDS,
    CASES,
    FLAT,
    OPERATOR,
    ROOMS,
    Answer,
    Case,
    answered,
    chosen,
    observed,
    of_random_starts,
)

ONE = "1 material × 1 light"
# One of each kind; the others are worse or better by degrees, or another kind's arithmetic (radiances times a factor).
QUICK_ONES = (
    *(ONE, "flat objects", "an object of 30 pixels", "a single pixel", "all Lambertian", "a black material"),
    *("a light of one point", "constant light", "half the values clipped", "20 % of normals wrong by 40°"),
    *("two equal materials", "a material without pixels", "NaN, infinite, no direction"),
)


@cache
def answer_to(name: str) -> Answer:
    return answered(CASES[name](0))


def bytes_of(answer: Answer) -> bytes:
    lights = b"".join(
        light.axis.tobytes() + light.log_sharpness.tobytes() + light.weight.tobytes()
        for light in answer.solution.point.lights
    )
    return answer.materials.vector().tobytes() + lights


def scaled(given: Case, factor: float) -> Case:
    replaced = msgspec.structs.replace
    return replaced(
        given, **{n: replaced(o, radiance=factor * o.radiance) for n in ("seen", "clean") for o in [getattr(given, n)]}
    )


def run_stage(folder, seen, **params):
    """The stage on one URM per photo; returns its materials."""
    (folder / "urm").mkdir(parents=True), (folder / "out").mkdir()
    for i, name in enumerate(seen.photos):
        own = seen.take(seen.photo == i)
        zero = np.zeros(len(own), int)
        own = msgspec.structs.replace(own, photos=(name,), illuminations=(name,), photo=zero, illumination=zero)
        write_observations(folder / "urm" / f"{name}.parquet", own)
    light = {name: {"illumination": name, "world_from_camera": None} for name in seen.photos}
    facts = {"dataset.materials": list(seen.materials), "dataset.light": light}
    inputs = Inputs({"urm": folder / "urm", "train": folder}, facts)
    quick = {"solver": "few_lobes", "operator": "closed_form", "lobes": 4, "insert": 4, "rounds": 1}
    quick |= {"iterations": 4, "polish": 3}
    stage.main(stage.Params(**(quick | params)), inputs, folder / "out", silent)
    return read_json(folder / "out" / "materials.json")["materials"]


def numbers(value) -> list[float]:
    if isinstance(value, dict):
        value = list(value.values())
    return [n for v in value for n in numbers(v)] if isinstance(value, list) else [value]


@pytest.mark.parametrize("name", [n if n in QUICK_ONES else pytest.param(n, marks=pytest.mark.long) for n in CASES])
def test_the_answer_is_within_its_bound_or_says_why_not(name):
    answer, bound = answer_to(name), BOUNDS[name]
    assert answer.finite() and answer.radiance <= bound.radiance
    assert bound.k is None or answer.k <= bound.k
    assert bound.roughness is None or answer.roughness <= bound.roughness
    for words in bound.says:
        assert any(words in sentence for sentence in answer.said), answer.said
    if not bound.says:
        assert [sentence for sentence in answer.said if bound.may_say is None or bound.may_say not in sentence] == []
    if name == "two equal materials":
        found = answer.materials.rows()
        np.testing.assert_allclose(found[0], found[1], atol=0.03)


def test_what_cannot_be_told_is_said():
    assert set(BOUNDS) == set(CASES)
    assert all(bound.says for bound in BOUNDS.values() if bound.k is None or bound.roughness is None)


@pytest.mark.parametrize("count", [3, pytest.param(10, marks=pytest.mark.long)])
def test_random_starts_find_one_answer(count):
    answers = of_random_starts(CASES[ONE](0), count)
    assert all(a.finite() for a in answers)
    assert sum(a.k < BOUNDS[ONE].k and a.roughness < BOUNDS[ONE].roughness for a in answers) >= 0.8 * count


def test_the_unit_of_radiance_changes_no_bit_of_the_answer():
    for power in (-40, 40):  # powers of two round nothing
        assert bytes_of(answered(scaled(CASES[ONE](0), 2.0**power))) == bytes_of(answer_to(ONE))


def test_observations_and_photos_in_another_order_are_the_same_blocks():
    seen = CASES["unconnected: 2 × 1 and 3 × 1"](0).seen
    other = seen.take(np.random.default_rng(0).permutation(len(seen)))
    names = {"photos": seen.photos[::-1], "illuminations": seen.illuminations[::-1]}
    other = msgspec.structs.replace(other, photo=1 - other.photo, illumination=1 - other.illumination, **names)
    shared = observed(chosen([1]), ROOMS[:2], [[0], [0]])
    one, x = np.zeros(len(shared), int), shared.x % (len(shared) // 2)
    shared = msgspec.structs.replace(shared, illumination=one, illuminations=("room",), x=x)
    turned = msgspec.structs.replace(shared, photo=1 - shared.photo, photos=shared.photos[::-1])
    for pair in ((seen, other), (shared, turned)):
        for a, b in zip(*(blocks_of_observations(of, Noise()) for of in pair), strict=True):
            for field in set(a.__struct_fields__) - {"row"}:  # the number in the order that was given
                np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def test_single_precision_of_the_operator_is_enough():
    double = answered(CASES[ONE](0), operator=reflection_operator("network", dtype="float64"))
    np.testing.assert_allclose(answer_to(ONE).materials.vector(), double.materials.vector(), atol=0.03)


def test_observations_that_are_not_finite_are_counted_and_spoil_no_neighbour(tmp_path, caplog):
    given = CASES["NaN, infinite, no direction"](0)
    with caplog.at_level(logging.WARNING):
        found = run_stage(tmp_path / "harmed", given.seen, merge_degrees=20.0)
    assert "observations are left out" in caplog.text
    assert np.isfinite(numbers(found)).all()
    kept = (
        np.isfinite(given.seen.radiance).all(1) & np.isfinite(given.seen.normal).all(1) & (given.seen.view != 0).any(1)
    )
    assert found == run_stage(tmp_path / "whole", given.seen.take(kept), merge_degrees=20.0)


def test_black_photos_are_named_and_nothing_but_black_is_an_error(tmp_path, caplog):
    seen = CASES["ordinary: 2 materials × 2 lights"](0).seen
    first = seen.photo == 0
    dark = msgspec.structs.replace(seen, radiance=np.where(first[:, None], 0.0, seen.radiance))
    with caplog.at_level(logging.WARNING):
        found = run_stage(tmp_path / "one", dark)
    assert "'room0' is black" in caplog.text
    assert np.isfinite(numbers(found)).all()
    with pytest.raises(InputError, match="black"):
        run_stage(tmp_path / "all", msgspec.structs.replace(seen, radiance=np.zeros_like(seen.radiance)))


def test_what_cannot_be_told_is_in_the_log_of_the_stage(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        run_stage(tmp_path, observed(chosen([1]), ROOMS[:1], [[0]], normals=FLAT))
    for words in ("is flat", "by convention only", "roughness of material 'red' cannot be determined"):
        assert words in caplog.text


def test_nothing_held_out_is_solved_too(tmp_path):
    assert np.isfinite(numbers(run_stage(tmp_path, CASES[ONE](0).seen, held_out=0.0))).all()


def test_where_nothing_is_held_out_fitted_observations_choose_the_round():
    given = CASES[ONE](0)
    all_, none = (blocks_of_observations(given.seen, Noise(), held_out=share) for share in (1e-9, 0.0))
    everything = [msgspec.structs.replace(block, held_out=np.ones(len(block), bool)) for block in all_]
    light = [msgspec.structs.replace(ROOMS[0], weight=ROOMS[0].weight / none[0].unit)]
    losses = [JointProblem(blocks, OPERATOR).held_out_loss(Point(given.truth, light)) for blocks in (everything, none)]
    assert losses[0] == losses[1] > 0


def test_one_bad_vote_of_held_out_observations_does_not_end_a_solve_that_still_finds_lobes(monkeypatch):
    votes = iter([1.0, 1.2] + [0.5] * 100)
    monkeypatch.setattr("factorlib.model.problem.JointProblem.held_out_loss", lambda *_: next(votes))
    history = answered(CASES[ONE](0)).solution.history
    assert [event.held_out for event in history if event.phase == "round"][:3] == [1.0, 1.2, 0.5]


def test_a_block_of_no_rows_has_no_slices():
    (block,) = blocks_of_observations(CASES[ONE](0).seen, Noise())
    assert material_slices(block.take(np.zeros(len(block), bool))) == []


def test_no_material_is_held_out_whole():
    seen = CASES["flat objects"](0).seen
    for seed in range(20):
        for block in blocks_of_observations(seen, Noise(), held_out=0.5, seed=seed):
            assert set(block.material[~block.held_out]) == set(block.material)
