"""`plan` as what it is, a pure function: tables in, steps with reasons out; and pipeline.yaml, which it is a plan of."""

import hypothesis.strategies as st
import pytest
from hypothesis import given

from factorlib.runner.plan import Listing, Spec, Step, difference, hash_of, plan
from factorlib.runner.project import Pipeline, Stage, read_pipeline
from tests.refusal import refusal

PIPELINE = Pipeline(
    1,
    {
        "masks": Stage(inputs=["dataset.photo"], over="photo", gather="photos.json"),
        "align": Stage(inputs=["dataset.objects", "masks"], over="photo"),
        "train": Stage(),
        "solve": Stage(inputs=["align", "train"]),
    },
)


def hashes(spec, **changed):
    """Each step's own record; `changed` is {stage or stage_photo: new value of its source}."""
    source = lambda s: changed.get(str(s).replace("/", "_"), changed.get(s.stage, 1))  # noqa: E731
    return {s: {"stage": s.stage, "photo": s.photo, "source:m": source(s)} for s in spec.steps()}


def run(spec, own, listing, same=()):
    """Carry a plan out on paper: every output is its key, or its step's old output for the steps in `same`. -> steps run"""
    outputs, previous, ran, forced = dict(listing.outputs), dict(listing.previous), [], set(spec.forced)
    while True:
        left = Spec(spec.pipeline, spec.photos, spec.targets, frozenset(forced))
        planned = plan(left, own, Listing(outputs, previous))
        todo = [p for p in planned if p.status == "to run" and p.key]
        if not todo:
            return ran, Listing(outputs, previous | {str(p.step): p.record for p in planned if p.record})
        for p in todo:
            old = outputs.get(hash_of(previous[str(p.step)])) if str(p.step) in previous else None
            outputs[p.key] = old if str(p.step) in same and old else f"out-{p.key}"
            previous[str(p.step)] = p.record
            forced.discard(p.step)
            ran.append(str(p.step))


def done(photos=("a", "b")):
    spec = Spec(PIPELINE, list(photos))
    return spec, run(spec, hashes(spec), Listing({}, {}))[1]


def open_steps(spec, own, listing):
    """Status and reasons of the steps that are not current."""
    return {str(p.step): (p.status, p.reasons) for p in plan(spec, own, listing) if p.status != "current"}


@pytest.mark.parametrize(
    "photos, forced, changed, expected, same, ran",
    [
        ("ab", [], {}, {}, (), []),
        ("abc", [], {}, {"masks/c": "to run", "align/c": "to run", "solve": "maybe"}, (), ["masks/c", "align/c", "solve"]),
        ("a", [], {}, {"solve": "to run"}, (), ["solve"]),
        ("ab", [], {"masks_a": 2}, {"masks/a": "to run", "align/a": "maybe", "solve": "maybe"}, (), ["masks/a", "align/a", "solve"]),
        ("ab", [], {"masks_a": 2}, {"masks/a": "to run", "align/a": "maybe", "solve": "maybe"}, ["masks/a"], ["masks/a"]),
        ("ab", [], {"masks_a": 2, "solve": 2}, {"masks/a": "to run", "align/a": "maybe", "solve": "to run"}, (), None),
        ("ab", [Step("masks", "a")], {}, {"masks/a": "to run", "align/a": "maybe", "solve": "maybe"}, (), ["masks/a"]),
    ],
    ids=["nothing", "a new photo", "one taken away", "a change", "the same output", "two changes", "forced"],
)  # fmt: skip
def test_what_runs_after_a_change_and_what_then_does(photos, forced, changed, expected, same, ran):
    _, listing = done()
    spec = Spec(PIPELINE, list(photos), None, frozenset(forced))
    own = hashes(spec, **changed)
    assert {step: status for step, (status, _) in open_steps(spec, own, listing).items()} == expected
    assert ran is None or run(spec, own, listing, same)[0] == ran


def test_the_reasons_are_what_differs_from_the_last_result_and_going_back_finds_the_old_one():
    spec, listing = done()
    assert open_steps(spec, hashes(spec, masks_a=2), listing)["masks/a"][1] == ["source of m: changed"]
    outputs = {k: v for k, v in listing.outputs.items() if k != hash_of(listing.previous["train"])}
    gone = open_steps(spec, hashes(spec), Listing(outputs, listing.previous))
    assert gone["train"] == ("to run", ["its result is gone"]) and gone["solve"][0] == "maybe"
    assert not open_steps(spec, hashes(spec), run(spec, hashes(spec, masks=2), listing)[1])
    assert [str(s) for s in Spec(PIPELINE, ["a"], ["align"]).steps()] == ["masks/a", "align/a"]


records = st.dictionaries(st.sampled_from(["param:a", "param:b", "source:m", "file:f", "threads"]), st.integers(0, 2))


@given(records, records)
def test_two_keys_are_equal_just_where_there_is_no_difference(one, other):
    assert (hash_of(one) == hash_of(other)) == (difference(one, other) == [])
    assert hash_of(one) == hash_of(dict(reversed(one.items())))


@given(
    st.permutations(["a", "b", "c"]),
    st.sets(st.sampled_from(["masks_a", "align_b", "train", "solve"])),
    st.sets(st.sampled_from(["masks/a", "train"])),
)
def test_whatever_changes_a_run_leaves_everything_current_and_runs_nothing_in_vain(photos, changed, same):
    _, listing = done(("a", "b", "c"))
    spec = Spec(PIPELINE, photos)  # the order of photos is no reason
    own = hashes(spec, **dict.fromkeys(changed, 2))
    planned = open_steps(spec, own, listing)
    ran, after = run(spec, own, listing, same)
    assert not open_steps(spec, own, after)
    assert len(ran) == len(set(ran)) and set(ran) <= planned.keys()
    assert {step for step, (status, _) in planned.items() if status == "to run"} <= set(ran)


# ── pipeline.yaml ────────────────────────────────────────────────────────────────────────────────────────────────────

GOOD = """format: 1
stages:
  one: {inputs: [dataset.photo], over: photo, gather: all.json}
  two: {inputs: [one], threads: 2, params: {a: 1e-3}}
"""


def read(tmp_path, text):
    (tmp_path / "pipeline.yaml").write_text(text)
    return read_pipeline(tmp_path / "pipeline.yaml", ("photo", "set"))


def test_a_stage_runs_after_what_it_takes_and_an_optional_one_only_where_it_is_asked_for_or_taken(tmp_path):
    pipeline = read(tmp_path, GOOD + "  three: {inputs: [two], optional: true}\n")
    assert pipeline.stages["two"].params == {"a": 0.001} and pipeline.order() == ["one", "two", "three"]
    assert pipeline.needed(["one"]) == ["one"] and pipeline.needed(None) == ["one", "two"]
    assert pipeline.needed(["three"]) == ["one", "two", "three"]
    taken = read(tmp_path, GOOD + "  three: {inputs: [one], optional: true}\n  four: {inputs: [three]}\n")
    assert set(taken.needed(None)) == {"one", "two", "three", "four"}


def test_a_stage_whose_slice_says_nothing_is_not_there_and_none_takes_its_results(tmp_path):
    pipeline = read(tmp_path, GOOD + "  three: {inputs: [two], when: set}\n  four: {inputs: [three, one]}\n")
    assert pipeline.for_data(lambda _: False) == pipeline
    without = pipeline.for_data(lambda name: name == "set")
    assert without.order() == ["one", "two", "four"] and without.stages["four"].inputs == ["one"]


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("[one]", "[oen]", ["stages.two.inputs", "did you mean 'one'"]),
        ("dataset.photo", "dataset.foto", ["stages.one.inputs", "did you mean 'dataset.photo'"]),
        ("threads", "thread", ["pipeline.yaml:4", "stages.two.thread", "did you mean 'threads'"]),
        ("threads: 2", "threads: 0", ["pipeline.yaml:4", "stages.two.threads", ">= 1"]),
        ("over: photo, ", "", ["stages.one.gather", "over: photo"]),
        ("over: photo", "over: mesh", ["stages.one.over"]),
        ("[dataset.photo]", "[two]", ["need each other", "one"]),
        ("threads: 2", "when: sett", ["stages.two.when", "did you mean 'set'"]),
        ("format: 1", "format: 2", ["pipeline.yaml:1: format: ", "write 1"]),
    ],
)
def test_what_is_refused(tmp_path, old, new, words):
    caught = refusal(".", read, tmp_path, GOOD.replace(old, new))
    assert all(word in str(caught) for word in words), str(caught)
