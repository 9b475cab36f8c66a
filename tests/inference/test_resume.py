"""A solve that is stopped anywhere and started again ends in the same bits, and does not start again from the beginning."""

import msgspec
import numpy as np
import pytest

from factorlib.checkpoint import Checkpoint
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference import joint_solver, model_selection, splitting
from factorlib.inference.fit import FitSchedule
from factorlib.inference.fit_runner import PHASES, Event, FitRunner, solve_progress
from factorlib.inference.joint_solver import solve
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.inference.start import start_from_photos
from factorlib.scenes.joint_problems import MATERIALS, block, random_light
from factorlib.stage import serial_map
from tests.inference.made_lights import OPERATOR

CHOICES = SolveOptions(cells=24, splittings=1, observations=100)
PARTS = ("effects", "tone", "distances", "materials", "splitting", "lights", "suns")
ALL = (*PHASES, "splitting 1", "lights", "suns")


class Killed(Exception):
    pass


@pytest.fixture(scope="module", autouse=True)
def short():
    """Where a descent ends does not matter here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_selection, "TRIAL", FitSchedule(2, (3,)))
        patch.setattr(model_selection, "DISTANCE_SCHEDULE", FitSchedule(joint_steps=(2,), estimate_first=False))
        patch.setattr(model_selection, "TONE_SCHEDULE", FitSchedule(joint_steps=(2,), estimate_first=False))
        patch.setattr(joint_solver, "MATERIALS", FitSchedule(2, (2,)))
        patch.setattr(splitting, "AFTER_SPLITTING", FitSchedule(1, (2,)))
        patch.setattr(joint_solver, "LIGHTS", FitSchedule(joint_steps=(0, 2), materials_fixed=True))
        yield


@pytest.fixture(scope="module")
def blocks():
    """Two lights with two photos each, some of which is hidden, and some sent by other surfaces, as is made up."""
    rng, directions = np.random.default_rng(4), np.stack([fibonacci_sphere(96)] * 2)
    lights = [random_light(rng, 2, photos=2) for _ in range(2)]
    made = [block(f"room{i}", li, MATERIALS, [0, 1, 2], OPERATOR, size=6) for i, li in enumerate(lights)]
    seen = [(255 * (rng.random((len(b), 96)) < 0.95)).astype(np.uint8) for b in made]
    hidden = [msgspec.structs.replace(b, visibility=v, directions=directions) for b, v in zip(made, seen)]
    bounced = [msgspec.structs.replace(b, bounced=0.01 * rng.random((len(b), 6))) for b in hidden]
    return [msgspec.structs.replace(b, place=rng.normal(size=(len(b), 3))) for b in bounced]


def answer(blocks, checkpoint=Checkpoint(None), spread=serial_map):
    """All numbers of an answer, and the events reported."""
    events = []

    parts = FitRunner(checkpoint, events.append)
    found = solve(JointProblem(blocks, OPERATOR, spread=spread), start_from_photos(3), CHOICES, parts)
    p = found.point
    parts = [p.materials.vector(), *(np.ravel(getattr(li, f)) for li in p.lights for f in li.__struct_fields__)]
    decided = [
        found.history,
        found.shadows,
        found.interreflection,
        found.tone,
        found.distances,
        found.splitting,
    ]
    hyper = [[one.value, one.hyperparameters] for one in (found.materials, found.fit)]
    return np.concatenate(parts).tobytes() + msgspec.json.encode([decided, hyper]), events


@pytest.fixture(scope="module")
def whole(blocks):
    return answer(blocks)


class Fragile(Checkpoint):
    """A checkpoint after which the process dies, once it holds a part."""

    def __init__(self, path, part):
        super().__init__(path)
        self.part = part

    def save(self, state):
        super().save(state)
        if self.part in state:
            raise Killed


@pytest.mark.parametrize("part", PARTS)
def test_a_solve_killed_after_a_part_goes_on_to_the_same_bits(blocks, whole, tmp_path, part):
    path = tmp_path / "solve.pt"
    with pytest.raises(Killed):
        answer(blocks, Fragile(path, part))
    again, events = answer(blocks, Checkpoint(path))
    assert again == whole[0]
    assert msgspec.json.encode(events) == msgspec.json.encode(whole[1])  # of parts that were done, too


def test_every_part_reports_what_it_does(whole):
    _, events = whole
    seen = [event.phase for event in events]
    assert set(seen) <= set(ALL) and set(ALL) - {"shadows and bounces", "suns"} <= set(seen)
    assert sorted(seen, key=ALL.index) == seen and all(np.isfinite(event.loss) for event in events)
    assert [event.round for event in events] == sorted(event.round for event in events)


def test_what_was_done_is_not_done_again_but_a_file_that_cannot_be_read_starts_the_solve_again(blocks, whole, tmp_path):
    """Killed after the last part, nothing of a descent is computed again."""
    path, work = tmp_path / "solve.pt", []
    with pytest.raises(Killed):
        answer(blocks, Fragile(path, "suns"))

    def counted(function, items):
        work.append(len(items))
        return serial_map(function, items)

    answer(blocks, Checkpoint(path), spread=counted)
    assert not work
    path.write_bytes(path.read_bytes()[:1000])
    assert answer(blocks, Checkpoint(path))[0] == whole[0]


def test_progress_never_goes_back_moves_with_every_point_and_is_whole_only_at_the_end():
    """With three starts each model is fitted three times: the first phases are entered anew."""
    said, effects, later = [], list(PHASES)[:3], [*list(PHASES)[3:], "splitting 1", "splitting 2", "lights", "suns"]
    report = solve_progress(lambda done, total, text: said.append(done / total), SolveOptions(splittings=2))
    for phase in [*(one for one in effects for _ in range(3)), *later]:
        for iteration in (*range(12), -1):
            report(Event(0, phase, iteration, 1.0, float("nan"), 400))
        if phase in later:
            assert len(set(said[-13:])) >= 12
    assert said == sorted(said) and 0 < said[0] < 0.01 and 0.99 < said[-1] < 1
