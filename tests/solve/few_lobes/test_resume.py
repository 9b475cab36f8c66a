"""A solve that is stopped anywhere and started again ends in the same bits, and does not start again from the beginning."""

import msgspec
import numpy as np
import pytest

from factorlib.checkpoint import Checkpoint
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes import insertion, rounds
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.rounds import from_nothing
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.resume import Journal
from factorlib.stage import serial_map
from tests.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("network")
OPTIONS = FewLobes(lobes=40, insert=1, rounds=2, iterations=2, polish=6, settle=6, sample=30)


class Killed(Exception):
    pass


@pytest.fixture(scope="module", autouse=True)
def small():
    """Most of the time would go into looking for lobes, and few observations would leave no phase to settle."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(insertion, "DICTIONARY", {1.0: 16, 30.0: 60})
        patch.setattr(rounds, "A_LOBE", 5)
        yield


@pytest.fixture(scope="module")
def blocks():
    """Two lights with two photos each, some of which is hidden by what is made up."""
    rng = np.random.default_rng(4)
    made = [
        block(f"room{i}", random_light(rng, 2, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=8, seed=i)
        for i in range(2)
    ]
    visibility = [(255 * (rng.random((len(b), 96)) < 0.9)).astype(np.uint8) for b in made]
    directions = np.stack([fibonacci_sphere(96)] * 2)
    return [
        msgspec.structs.replace(b, visibility=v, directions=directions) for b, v in zip(made, visibility, strict=True)
    ]


def answer(blocks, journal=None, stop=lambda event: False):
    """All numbers of an answer, and the events reported."""
    events = []

    def report(event):
        events.append(event)
        if stop(event):
            raise Killed

    found = few_lobes(
        JointProblem(blocks, OPERATOR), from_nothing(3), Run(OPTIONS, report, journal=journal or Journal())
    )
    p = found.point
    parts = [
        p.materials.vector(),
        found.lambertian,
        *(getattr(li, f).reshape(-1) for li in p.lights for f in li.__struct_fields__),
    ]
    decided = msgspec.json.encode([found.history, found.shadows, found.specular, found.loss])
    return np.concatenate(parts).tobytes() + decided, events


@pytest.fixture(scope="module")
def whole(blocks):
    return answer(blocks)


def places(events):
    """The number of the event at which each place to stop is first reached."""
    rounds_ = [k for k, event in enumerate(events) if event.phase == "round"]
    polish = [k for k, event in enumerate(events) if event.phase == "polish"]
    return {
        "a later round": next(k for k, event in enumerate(events) if event.round == 1),
        "the last round": rounds_[-1],
        "the choice": polish[0] - 1,
        "polish, after the choice": polish[0],
        "settle": polish[-1],
    }


PLACES = ("a later round", "the last round", "the choice", "polish, after the choice", "settle")


@pytest.mark.parametrize("place", PLACES)
def test_a_killed_solve_goes_on_to_the_same_bits(blocks, whole, tmp_path, place):
    bits, events = whole
    at = places(events)[place]
    seen = []
    with pytest.raises(Killed):
        answer(
            blocks, Journal(Checkpoint(tmp_path / "solve.pt")), lambda event: seen.append(event) or len(seen) == at + 1
        )
    again, _ = answer(blocks, Journal(Checkpoint(tmp_path / "solve.pt")))
    assert again == bits


def test_what_was_done_is_not_done_again(blocks, tmp_path):
    """Killed in the last phase, hardly anything is computed again; the rounds are reported again, for who shows progress."""
    file, work = tmp_path / "solve.pt", []

    def killed_in_the_last_phase(function, items):
        if "polish 0" in (Checkpoint(file).load() or {}):
            raise Killed
        return serial_map(function, items)

    with pytest.raises(Killed):
        problem = JointProblem(blocks, OPERATOR, spread=killed_in_the_last_phase)
        few_lobes(problem, from_nothing(3), Run(OPTIONS, lambda event: None, journal=Journal(Checkpoint(file))))

    def counted(function, items):
        work.append(len(items))
        return serial_map(function, items)

    run = Run(OPTIONS, lambda event: work.append(0), journal=Journal(Checkpoint(file)))
    few_lobes(JointProblem(blocks, OPERATOR, spread=counted), from_nothing(3), run)
    assert sum(work) <= len(blocks) * (OPTIONS.settle + 2)  # where it starts, its steps, the end in gauge


def test_a_file_that_cannot_be_read_starts_the_solve_again(blocks, whole, tmp_path):
    path = tmp_path / "solve.pt"
    answer(blocks, Journal(Checkpoint(path)))
    path.write_bytes(path.read_bytes()[:1000])
    assert answer(blocks, Journal(Checkpoint(path)))[0] == whole[0]
