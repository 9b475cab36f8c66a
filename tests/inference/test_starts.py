"""An earlier solution as a start, and a solve that is stopped and started again: the answer is the one from nothing."""

import msgspec
import numpy as np
import pytest

from factorlib.checkpoint import Checkpoint
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference import joint_solver
from factorlib.inference.choices import model_selection
from factorlib.inference.fit.fit import FitSchedule
from factorlib.inference.fit.fit_runner import PHASES, Event, FitRunner, solve_progress
from factorlib.inference.fit.start import (
    InitialFit,
    point_from_earlier,
    start_from_earlier,
    start_from_photos,
    start_from_surface,
    with_earlier_decisions,
)
from factorlib.inference.joint_solver import solve
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.materials import Materials
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.results.materials import Gauge, MaterialTable, Model, Reflectance, Tone
from factorlib.results.solution import EarlierSolution
from factorlib.scenes.joint_problems import MATERIALS, factor_between, random_light, sphere_block
from factorlib.stage import serial_map
from tests.inference.made_lights import FEW, OPERATOR, drawn, natural, on_even_cells, spheres
from tests.stages.made import Killed

NAMES, CELLS = ["red", "green", "blue"], 40


def truth(*numbers, shown=(0, 1, 2), photos=1, noise=0.0, size=10):
    """Blocks and the true lights in the unit of their block."""
    blocks, lights = [], []
    for number in numbers:
        exposure = np.concatenate([[0.0], np.random.default_rng(number).normal(0, 0.5, photos - 1)])
        light = on_even_cells(drawn(50 + number, CELLS), exposure)
        (block,) = spheres([light], size=size, shown=shown, noise=noise, seed=number).blocks
        name = f"room{number}"
        blocks.append(msgspec.structs.replace(block, name=name, photos=tuple(f"{name}_{k}" for k in range(photos))))
        lights.append(msgspec.structs.replace(light, weight=light.weight / block.unit))
    return blocks, lights


def first(materials: Materials, count: int) -> Materials:
    return Materials.from_rows(materials.rows()[:count])


def written(blocks, materials: Materials, lights, names=NAMES, component=(0, 0, 0)) -> EarlierSolution:
    """As the stage writes it and `read_earlier_solution` reads it."""
    rows = materials.rows().tolist()
    solved = {name: Reflectance(tuple(r[:3]), tuple(r[3:6]), r[6]) for name, r in zip(names, rows, strict=True)}
    table = MaterialTable(solved, Gauge(component=dict(zip(names, component, strict=True))), Model())
    pairs = list(zip(blocks, lights, strict=True))
    lobes = {b.name: li.lobes.scale(b.unit) for b, li in pairs}
    photos = [pair for b, li in pairs for pair in zip(b.photos, li.log_exposure, strict=True)]
    return EarlierSolution(table, lobes, {photo: (float(np.exp(e)),) * 3 for photo, e in photos})


def start_from(earlier, blocks, names=NAMES):
    point = start_from_earlier(earlier, names)(JointProblem(blocks, OPERATOR), CELLS)[0].point
    return point.materials, point.lights


def explained(blocks, materials, lights, atol=1e-3):
    for b, light in zip(blocks, lights, strict=True):
        np.testing.assert_allclose(
            Illumination(b, light, materials, OPERATOR).radiance(), b.radiance, atol=atol, rtol=atol
        )


def check_same_but_for_the_gauge(found: Materials, true=MATERIALS):
    factor = factor_between(found, true)
    np.testing.assert_allclose(found.diffuse * factor, true.diffuse, rtol=1e-9)
    np.testing.assert_allclose(found.specular * factor, true.specular, rtol=1e-9)
    np.testing.assert_array_equal(found.roughness, true.roughness)


def test_what_is_known_is_taken_over_whatever_the_order_and_the_units():
    blocks, lights = truth(0, 1)
    turned = [msgspec.structs.replace(b, unit=7 * b.unit, radiance=b.radiance / 7) for b in reversed(blocks)]
    materials, result = start_from(written(blocks, MATERIALS, lights), turned)
    check_same_but_for_the_gauge(materials)
    explained(turned, materials, result)
    for light, before in zip(result, reversed(lights), strict=True):
        np.testing.assert_allclose(light.axis, before.axis, atol=1e-12)


def test_cells_that_split_stay_as_small_as_they_are():
    """A cell of 400 that splits three times has λ = 8,149; a wider one of the same weight would be brighter."""
    (block,), (light,) = truth(0)
    for _ in range(6):
        light = light.split(np.arange(len(light)) >= len(light) - 2)
    assert light.sharpness.max() > 10_000
    shown = msgspec.structs.replace(block, radiance=Illumination(block, light, MATERIALS, OPERATOR).radiance())
    _, (result,) = start_from(written([shown], MATERIALS, [light]), [shown])
    np.testing.assert_allclose(result.sharpness, light.sharpness, rtol=1e-12)


def test_a_light_nobody_knows_is_constant_and_the_known_ones_stay():
    blocks, lights = truth(0, 1)
    materials, result = start_from(written(blocks[:1], MATERIALS, lights[:1]), blocks)
    check_same_but_for_the_gauge(materials)
    explained(blocks[:1], materials, result[:1])
    assert np.ptp(result[1].log_radiance, axis=1).max() < 1e-9 and len(result[1]) == CELLS
    mean = Illumination(blocks[1], result[1], materials, OPERATOR).radiance().mean()
    assert abs(np.log(mean)) < 0.5  # a block's is 1


def test_a_material_nobody_knows_stands_beside_the_known_ones():
    """Its reflectance is as its mean radiance says, on the scale of the others."""
    blocks, lights = truth(0, 1)
    materials, result = start_from(written(blocks, first(MATERIALS, 2), lights, NAMES[:2], (0, 0)), blocks)
    whole, true = (m.diffuse + m.specular for m in (materials, MATERIALS))
    check_same_but_for_the_gauge(first(materials, 2), first(MATERIALS, 2))
    ratio = (whole[2] / whole[:2].mean(0)) / (true[2] / true[:2].mean(0))
    assert (np.abs(np.log(ratio)) < np.log(2)).all()
    known = [b.take(b.material < 2) for b in blocks]
    explained(known, materials, result)


def test_a_photo_new_to_a_light_gets_its_exposure_even_where_it_comes_first():
    blocks, lights = truth(0, photos=3)
    earlier = written(blocks, MATERIALS, lights)
    new, *others = blocks[0].photos
    factor = earlier.exposures[others[0]][0]
    relative = {photo: tuple(np.array(earlier.exposures[photo]) / factor) for photo in others}
    lobes = {name: light.scale(factor) for name, light in earlier.lights.items()}  # as it was without `new`
    earlier = msgspec.structs.replace(earlier, exposures=relative, lights=lobes)
    materials, (light,) = start_from(earlier, blocks)
    np.testing.assert_allclose(light.log_exposure, lights[0].log_exposure, atol=0.02)
    explained(blocks, materials, [light], atol=0.02)


def test_a_light_that_is_no_longer_so_starts_anew_and_is_named(caplog):
    blocks, lights = truth(0, 1)
    turned = [msgspec.structs.replace(lights[0], axis=-lights[0].axis, weight=lights[0].weight ** 2), lights[1]]
    materials, result = start_from(written(blocks, MATERIALS, turned), blocks)
    assert "'room0' starts anew" in caplog.text and "room1" not in caplog.text
    assert np.ptp(result[0].log_radiance, axis=1).max() < 1e-9
    explained(blocks[1:], materials, result[1:])


def test_tone_curves_are_taken_over_and_a_photo_new_to_their_light_gets_the_mean_of_theirs():
    blocks, lights = truth(0, 1, photos=3)
    earlier = written(blocks, MATERIALS, lights)
    curves = {photo: Tone(exponent, blocks[0].unit) for photo, exponent in zip(blocks[0].photos[1:], (1.1, 1.2))}
    model = msgspec.structs.replace(earlier.table.model, tone=curves)
    earlier = msgspec.structs.replace(earlier, table=msgspec.structs.replace(earlier.table, model=model))
    light, straight = point_from_earlier(JointProblem(blocks, OPERATOR), earlier, NAMES, CELLS).lights
    np.testing.assert_allclose(np.exp(light.log_tone), [np.sqrt(1.1 * 1.2), 1.1, 1.2])
    assert len(straight.log_tone) == 0


@pytest.mark.parametrize(("kept", "tried"), [(True, True), (False, True), (True, False)])
def test_shadows_and_bounces_stay_as_they_were_decided_where_both_were_tried(kept, tried):
    losses = {"held_out_loss_with": 1.0} | ({"held_out_loss_without": 2.0, "margin": 3.0} if tried else {})
    chosen = {"self_shadowing_chosen_by": losses, "interreflection_chosen_by": losses}
    model = Model(self_shadowing=kept, interreflection=not kept, **chosen)
    earlier = EarlierSolution(MaterialTable({}, Gauge(), model), {}, {})
    result, names = with_earlier_decisions(SolveOptions(), earlier), ["off", "on"]
    expected = [names[kept], names[not kept]] if tried else ["auto", "auto"]
    assert [result.self_shadowing, result.interreflection] == expected
    asked = SolveOptions(self_shadowing="off", interreflection="on")
    assert with_earlier_decisions(asked, earlier) == asked


# ── whole answers ────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_solve_goes_on_from_the_fit_that_surface_wrote_in_whatever_unit_a_block_has():
    problem, _, fit = natural()
    written = msgspec.json.decode(msgspec.json.encode(InitialFit.from_fit(fit, problem.blocks)), type=InitialFit)
    block = problem.blocks[0]
    brighter = msgspec.structs.replace(block, unit=4 * block.unit)
    (result,) = start_from_surface(written)(problem.with_blocks([brighter, *problem.blocks[1:]]), FEW)
    assert result.hyperparameters == fit.hyperparameters and result.fitted
    for light, before, factor in zip(result.point.lights, fit.point.lights, (4, 1, 1), strict=True):
        np.testing.assert_allclose(light.weight * factor, before.weight, rtol=1e-12)
        np.testing.assert_array_equal(light.axis, before.axis)
    np.testing.assert_array_equal(result.point.materials.rows(), fit.point.materials.rows())


def test_a_light_of_other_cells_or_photos_than_the_fit_had_begins_constant():
    problem, _, fit = natural()
    begun = start_from_surface(InitialFit.from_fit(fit, problem.blocks))
    (coarse,) = begun(problem, 30)
    assert all(np.ptp(light.log_radiance, axis=1).max() < 0.2 for light in coarse.point.lights)
    assert not coarse.fitted  # so that it is descended from as from nothing
    two = msgspec.structs.replace(problem.blocks[0], photos=("room0", "another"))
    light = begun(problem.with_blocks([two, *problem.blocks[1:]]), FEW)[0].point.lights[0]
    assert len(light.log_exposure) == 2 and np.ptp(light.log_radiance, axis=1).max() < 0.2


# ── A solve that is stopped anywhere and started again ends in the same bits, and does not start again from the begin


CHOICES = SolveOptions(cells=24, splittings=1, observations=100)
PARTS = ("effects", "tone", "distances", "materials", "prior", "lights", "suns")
ALL = tuple(PHASES)


@pytest.fixture(scope="module", autouse=True)
def short():
    """Where a descent ends does not matter here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_selection, "TRIAL", FitSchedule(2, (3,)))
        patch.setattr(model_selection, "DISTANCE_SCHEDULE", FitSchedule(descents=(2,), estimate_first=False))
        patch.setattr(model_selection, "TONE_SCHEDULE", FitSchedule(descents=(2,), estimate_first=False))
        patch.setattr(joint_solver, "MATERIALS", FitSchedule(2, (2,)))
        patch.setattr(joint_solver, "LIGHTS", FitSchedule(descents=(0, 2), materials_fixed=True))
        yield


@pytest.fixture(scope="module")
def blocks():
    """Two lights with two photos each, some of which is hidden, and some sent by other surfaces, as is made up."""
    rng, directions = np.random.default_rng(4), np.stack([fibonacci_sphere(96)] * 2)
    lights = [random_light(rng, 2, photos=2) for _ in range(2)]
    lit = [sphere_block(f"room{i}", li, MATERIALS, [0, 1, 2], OPERATOR, size=6) for i, li in enumerate(lights)]
    visibilities = [(255 * (rng.random((len(b), 96)) < 0.95)).astype(np.uint8) for b in lit]
    hidden = [msgspec.structs.replace(b, visibility=v, directions=directions) for b, v in zip(lit, visibilities)]
    bounced = [msgspec.structs.replace(b, bounced=0.01 * rng.random((len(b), 6))) for b in hidden]
    return [msgspec.structs.replace(b, place=rng.normal(size=(len(b), 3))) for b in bounced]


def answer_bytes(blocks, checkpoint=Checkpoint(None), spread=serial_map):
    """All numbers of an answer, and the events reported."""
    events = []

    parts = FitRunner(checkpoint, events.append)
    result = solve(JointProblem(blocks, OPERATOR, spread=spread), start_from_photos(3), CHOICES, parts)
    p = result.point
    parts = [p.materials.vector(), *(np.ravel(getattr(li, f)) for li in p.lights for f in li.__struct_fields__)]
    decided = [
        result.history,
        result.shadows,
        result.interreflection,
        result.tone,
        result.distances,
        result.splitting,
    ]
    hyper = [[one.value, one.hyperparameters] for one in (result.materials, result.fit)]
    return np.concatenate(parts).tobytes() + msgspec.json.encode([decided, hyper]), events


@pytest.fixture(scope="module")
def whole(blocks):
    return answer_bytes(blocks)


class Fragile(Checkpoint):
    """A checkpoint after which the process dies, once it holds a part."""

    def __init__(self, path, part):
        super().__init__(path)
        self.part = part

    def save(self, state):
        super().save(state)
        if self.part in state:
            raise Killed


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_a_solve_killed_after_a_part_goes_on_to_the_same_bits(blocks, whole, tmp_path, part):
    path = tmp_path / "solve.pt"
    with pytest.raises(Killed):
        answer_bytes(blocks, Fragile(path, part))
    again, events = answer_bytes(blocks, Checkpoint(path))
    assert again == whole[0]
    assert msgspec.json.encode(events) == msgspec.json.encode(whole[1])  # of parts that were done, too


def test_every_part_reports_what_it_does(whole):
    _, events = whole
    visibilities = [event.phase for event in events]
    assert set(visibilities) <= set(ALL) and set(ALL) - {
        "no shadows",
        "shadows and bounces",
        "background",
        "distances",
        "more observations",
        "suns",
    } <= set(visibilities)
    assert sorted(visibilities, key=ALL.index) == visibilities and all(np.isfinite(event.loss) for event in events)
    assert [event.round for event in events] == sorted(event.round for event in events)


@pytest.mark.long
def test_what_was_done_is_not_done_again_but_a_file_that_cannot_be_read_starts_the_solve_again(blocks, whole, tmp_path):
    """Killed after the last part, nothing of a descent is computed again."""
    path, work = tmp_path / "solve.pt", []
    with pytest.raises(Killed):
        answer_bytes(blocks, Fragile(path, "suns"))

    def counted(function, items):
        work.append(len(items))
        return serial_map(function, items)

    answer_bytes(blocks, Checkpoint(path), spread=counted)
    assert not work
    path.write_bytes(path.read_bytes()[:1000])
    assert answer_bytes(blocks, Checkpoint(path))[0] == whole[0]


def test_progress_never_goes_back_moves_with_every_point_and_is_whole_only_at_the_end():
    """With three starts each model is fitted three times: the first phases are entered anew."""
    shares, effects, later = [], list(PHASES)[:3], list(PHASES)[3:]
    report = solve_progress(lambda done, total, text: shares.append(done / total))
    for phase in [*(one for one in effects for _ in range(3)), *later]:
        for iteration in range(13):
            report(Event(0, phase, iteration, 1.0, float("nan"), 400))
        if phase in later:
            assert len(set(shares[-13:])) >= 12
    assert shares == sorted(shares) and 0 < shares[0] < 0.01 and 0.9 < shares[-1] < 1
