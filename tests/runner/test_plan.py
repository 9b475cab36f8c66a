"""`plan` as what it is, a pure function: tables in, steps with reasons out."""

import hypothesis.strategies as st
from hypothesis import given

from factorlib.runner.pipeline import Pipeline, Stage
from factorlib.runner.plan import Listing, Spec, Step, difference, key_of, plan

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
    return {
        s: {
            "stage": s.stage,
            "photo": s.photo,
            "source:m": changed.get(str(s).replace("/", "_"), changed.get(s.stage, 1)),
        }
        for s in spec.steps()
    }


def run(spec, own, listing, same=()):
    """Carry a plan out on paper: every output is its key, or its step's old output for the steps in `same`. -> steps run"""
    outputs, previous, ran, forced = dict(listing.outputs), dict(listing.previous), [], set(spec.forced)
    while True:
        now = Spec(spec.pipeline, spec.photos, spec.targets, frozenset(forced))
        todo = [p for p in plan(now, own, Listing(outputs, previous)) if p.status == "to run" and p.key]
        if not todo:
            return ran, Listing(
                outputs,
                {**previous, **{str(p.step): p.record for p in plan(now, own, Listing(outputs, previous)) if p.record}},
            )
        for p in todo:
            old = outputs.get(key_of(previous[str(p.step)])) if str(p.step) in previous else None
            outputs[p.key] = old if str(p.step) in same and old else f"out-{p.key}"
            previous[str(p.step)] = p.record
            forced.discard(p.step)
            ran.append(str(p.step))


def done(photos=("a", "b")):
    spec = Spec(PIPELINE, list(photos))
    return spec, run(spec, hashes(spec), Listing({}, {}))[1]


def statuses(spec, own, listing):
    return {str(p.step): p.status for p in plan(spec, own, listing)}


def test_at_first_everything_runs_once_and_then_nothing():
    spec = Spec(PIPELINE, ["a", "b"])
    ran, listing = run(spec, hashes(spec), Listing({}, {}))
    assert sorted(ran) == ["align/a", "align/b", "masks/a", "masks/b", "solve", "train"] and ran[-1] == "solve"
    assert set(statuses(spec, hashes(spec), listing).values()) == {"current"}


def test_a_new_photo_costs_that_photo_and_the_set():
    _, listing = done()
    spec = Spec(PIPELINE, ["a", "b", "c"])
    assert run(spec, hashes(spec), listing)[0] == ["masks/c", "align/c", "solve"]


def test_a_photo_taken_away_costs_the_set_only():
    _, listing = done()
    spec = Spec(PIPELINE, ["a"])
    planned = {str(p.step): p for p in plan(spec, hashes(spec), listing)}
    assert [s for s, p in planned.items() if p.status != "current"] == ["solve"]
    assert planned["solve"].reasons == ["result of align/b: gone"]


def test_a_change_runs_its_step_and_what_follows_is_maybe():
    spec, listing = done()
    own = hashes(spec, masks_a=2)
    assert statuses(spec, own, listing) == {
        "masks/a": "to run", "masks/b": "current", "train": "current", "align/a": "maybe", "align/b": "current", "solve": "maybe",
    }  # fmt: skip
    assert plan(spec, own, listing)[0].reasons == ["source of m: changed"]


def test_an_output_that_comes_out_the_same_stops_there():
    spec, listing = done()
    assert run(spec, hashes(spec, masks_a=2), listing, same=("masks/a",))[0] == ["masks/a"]
    assert run(spec, hashes(spec, masks_a=2), listing)[0] == ["masks/a", "align/a", "solve"]


def test_what_has_changed_itself_is_no_maybe():
    spec, listing = done()
    assert statuses(spec, hashes(spec, masks_a=2, solve=2), listing)["solve"] == "to run"


def test_going_back_finds_the_old_result():
    spec, listing = done()
    _, later = run(spec, hashes(spec, masks=2), listing)
    assert set(statuses(spec, hashes(spec), later).values()) == {"current"}


def test_forced_steps_run_and_others_only_if_that_changes_something():
    spec, listing = done()
    forced = Spec(PIPELINE, ["a", "b"], None, frozenset([Step("masks", "a")]))
    found = statuses(forced, hashes(forced), listing)
    assert found["masks/a"] == "to run" and found["align/a"] == "maybe" and found["masks/b"] == "current"
    assert run(forced, hashes(forced), listing)[0] == ["masks/a"]


def test_only_what_a_target_needs_is_planned():
    spec = Spec(PIPELINE, ["a"], ["align"])
    assert [str(s) for s in spec.steps()] == ["masks/a", "align/a"]


def test_a_result_that_was_deleted_is_made_again():
    spec, listing = done()
    key = key_of(listing.previous["train"])
    found = plan(spec, hashes(spec), Listing({k: v for k, v in listing.outputs.items() if k != key}, listing.previous))
    assert [(str(p.step), p.status, p.reasons) for p in found if p.status == "to run"] == [
        ("train", "to run", ["its result is gone"])
    ]


records = st.dictionaries(st.sampled_from(["param:a", "param:b", "source:m", "file:f", "threads"]), st.integers(0, 2))


@given(records, records)
def test_two_keys_are_equal_just_where_there_is_no_difference(one, other):
    assert (key_of(one) == key_of(other)) == (difference(one, other) == [])
    assert key_of(one) == key_of(dict(reversed(one.items())))


@given(
    st.permutations(["a", "b", "c"]),
    st.sets(st.sampled_from(["masks_a", "align_b", "train", "solve"])),
    st.sets(st.sampled_from(["masks/a", "train"])),
)
def test_whatever_changes_a_run_leaves_everything_current_and_runs_nothing_in_vain(photos, changed, same):
    spec, listing = done(("a", "b", "c"))
    spec = Spec(PIPELINE, photos)  # the order of photos is no reason
    own = hashes(spec, **dict.fromkeys(changed, 2))
    planned = statuses(spec, own, listing)
    ran, after = run(spec, own, listing, same)
    assert set(statuses(spec, own, after).values()) == {"current"}
    assert len(ran) == len(set(ran)) and all(planned[step] != "current" for step in ran)
    assert {step for step, status in planned.items() if status == "to run"} <= set(ran)
