"""What the solve chose, in sentences; and whatever is no better than its null has one, and nothing else has."""

import msgspec

from factorlib.report.template import sentences
from factorlib.results.materials import Decision, Model, Reflectance, Tone
from factorlib.results.metrics import (
    AngleError,
    ComparedMaterial,
    Counts,
    LightError,
    LightErrors,
    MaterialError,
    MaterialErrors,
    Metrics,
    NormalError,
    PictureError,
    Relighting,
    RelitBall,
    Resynthesis,
    ScoredLight,
)  # fmt: skip

LOSSES = {"held_out_loss_with": 0.974, "held_out_loss_without": 1.184}
GAUGE = "channel_per_photo"
VIEWS = ("mirror", "glossy", "lambertian", "map_all", "map_mirrored", "map_unmirrored")


def choices(**model):
    return sentences("choices.txt", model=Model(**model))


def test_every_choice_has_a_sentence_with_its_losses():
    assert choices(
        lobes={"hall": 472, "patio": 472}, lobes_chosen_by="cells of the light prior", light_prior=True, interreflection=True,
        splitting_chosen_by=[Decision(True, 0.9, 1.2, 4.25), Decision(False, 0.95, 0.9, -1.5)],
        interreflection_chosen_by=LOSSES | {"margin": 3.5}, self_shadowing_chosen_by=LOSSES | {"margin": -2.5},
        tone={"hall": Tone(1.2, 0.4)}, tone_chosen_by={"hall": Decision(True, 1.0, 1.5), "patio": Decision(False)},
        distance={"hall": 10.0}, distance_chosen_by={"hall": Decision(True, 2.0, 2.5, 3.0), "patio": Decision(False)},
    ) == [
        "Each light is 472 lobes: cells of the light prior.",
        "The brightest cells of each light were split: kept (held-out loss 0.900 with it, 1.20 without, 4.2 standard errors for it); then "
        "not kept (held-out loss 0.950 with it, 0.900 without, 1.5 standard errors against it).",
        "Shadow of surfaces on one another is not in the model (held-out loss 0.974 with it, 1.18 without, 2.5 standard errors against it).",
        "Light that surfaces send to one another is in the model (held-out loss 0.974 with it, 1.18 without, 3.5 standard errors for it).",
        "Photos with a tone curve of their own, taken back by the model: hall, exponent 1.20 (held-out loss 1.00 with it, 1.50 without).",
        "Lights at a finite distance, in RMS distances of what the photo shows from its middle: hall, 10 (held-out loss 2.00 with it, 2.50 "
        "without, 3.0 standard errors for it).",
    ]  # fmt: skip


def test_nothing_is_said_of_what_was_not_asked():
    given = "Each light is 32 lobes, a number that was given, as in the paper's solver."
    assert choices(solver="paper", lobes={"hall": 32})[0] == given
    assert choices()[0] == "Shadow of surfaces on one another is not in the model."
    assert not any("split" in said for said in choices(lobes={"hall": 400}, light_prior=True))
    assert choices(distance_chosen_by={"hall": Decision(False)})[-1] == "All lights are infinitely far away."
    assert choices(tone_chosen_by={"hall": Decision(False)})[-1] == "No photo has a tone curve of its own."


def guesses(metrics):
    return sentences("guesses.txt", metrics=metrics)


def metrics_of(error: float) -> Metrics:
    """Everything wrong by `error`, beside nulls that are wrong by 1 (and 10°, 20 dB)."""
    light = {view: ScoredLight(LightError(error, error, 10 * error), LightError(1.0, 1.0, 10.0)) for view in VIEWS}
    grey = Reflectance((0.5,) * 3, (0.05,) * 3, 0.5)
    part = ComparedMaterial(0, grey, grey, *(MaterialError(e, (e, -e, e), (-e, e, e)) for e in (error, 1.0)))
    psnr = {"in_estimated_light": 20 / error, "in_true_light": 30, "null_grey": 20}
    kinds = {kind: PictureError(0, db, 0) for kind, db in psnr.items()}
    return Metrics(
        Counts(1, 1, 1, 1),
        Resynthesis({}, None, None, None),
        MaterialErrors({"0": (1.0,) * 3}, {"oak": part}, *(error,) * 6, *(1.0,) * 3),
        Relighting({"hall": {"oak": RelitBall(True, 1.0, {GAUGE: kinds})}}, {}, None),
        LightErrors({"hall": {GAUGE: light}}, {}, {"hall": 0.5}),
        {"a": NormalError(9, AngleError(10 * error, 0), AngleError(10.0, 0))},
        None,
        {},
    )


def test_what_its_null_beats_has_a_line_with_both_numbers_and_nothing_else_has():
    assert guesses(metrics_of(0.9)) == []
    assert guesses(metrics_of(1.1)) == [
        "The recovered 'oak' is worse than a grey guess (in brackets): roughness, wrong by 1.10 (1.00); diffuse colour, wrong by 110 % (100 %); "
        "specular colour, wrong by 110 % (100 %).",
        "In every light a ball of the recovered 'oak' in the recovered light looks less like the true one than a plain grey ball does, both tinted to fit. "
        "But the grey ball is in the true light, which nobody has in practice.",
        "The light 'hall' is further from the truth than a constant light is (in brackets): mirror sphere 110 % (100 %), glossy sphere 110 % (100 %), "
        "lambertian sphere 110 % (100 %), colours 11.0° (10.0°).",
        "a: normals are wrong by 11.0°, those of a flat disc by 10.0°. Look at the overlay.",
    ]  # fmt: skip
    nothing = dict.fromkeys(("materials", "relighting", "light", "normals", "poses"))
    assert guesses(Metrics(Counts(1, 1, 1, 1), Resynthesis({}, None, None, None), **nothing, reasons={})) == []


def test_lights_in_which_a_material_is_worse_than_grey_stand_in_one_line():
    found = metrics_of(0.9)
    (bad,), (good,) = (list(metrics_of(error).relighting.balls.values()) for error in (1.1, 0.9))
    balls = {f"l{k}": bad for k in range(5)} | {"hall": good}
    found = msgspec.structs.replace(found, relighting=Relighting(balls, {}, None))
    assert guesses(found) == [
        "In 5 of 6 lights (l0, l1, l2 and 2 more) a ball of the recovered 'oak' in the recovered light looks less like the true one than a plain grey ball "
        "does, both tinted to fit. But the grey ball is in the true light, which nobody has in practice."
    ]


def test_one_number_is_enough():
    found = metrics_of(0.9)
    found.light.lights["hall"][GAUGE]["map_all"] = ScoredLight(LightError(0.9, 0.9, 12.0), LightError(1.0, 1.0, 10.0))
    (sentence,) = guesses(found)
    assert "12.0°" in sentence and "sphere" not in sentence
