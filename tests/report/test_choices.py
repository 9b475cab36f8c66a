"""What the solve chose, in sentences."""

from factorlib.report.template import sentences
from factorlib.results.materials import Decision, Model, Tone


def choices(model):
    return sentences("choices.txt", model=model)


LOSSES = {"held_out_loss_with": 0.974, "held_out_loss_without": 1.184}


def test_every_choice_has_a_sentence_with_its_losses():
    model = Model(
        lobes={"hall": 472, "patio": 472}, lobes_chosen_by="cells of the light prior", light_prior=True, interreflection=True,
        splitting_chosen_by=[Decision(True, 0.9, 1.2, 4.25), Decision(False, 0.95, 0.9, -1.5)],
        interreflection_chosen_by=LOSSES | {"margin": 3.5}, self_shadowing_chosen_by=LOSSES | {"margin": -2.5},
        specular={"red": True, "wall": False}, specular_chosen_by={"wall": Decision(False, 1.5, 1.25)},
        tone={"hall": Tone(1.2, 0.4)}, tone_chosen_by={"hall": Decision(True, 1.0, 1.5), "patio": Decision(False)},
    )  # fmt: skip
    assert choices(model) == [
        "Each light is 472 lobes: cells of the light prior.",
        "The brightest cells of each light were split: kept (held-out loss 0.900 with it, 1.20 without, 4.2 standard errors for it); then "
        "not kept (held-out loss 0.950 with it, 0.900 without, 1.5 standard errors against it).",
        "Shadow of surfaces on one another is not in the model (held-out loss 0.974 with it, 1.18 without, 2.5 standard errors against it).",
        "Light that surfaces send to one another is in the model (held-out loss 0.974 with it, 1.18 without, 3.5 standard errors for it).",
        "wall has no specular part (held-out loss 1.50 with it, 1.25 without).",
        "Photos with a tone curve of their own, taken back by the model: hall, exponent 1.20 (held-out loss 1.00 with it, 1.50 without).",
    ]


def test_nothing_is_said_of_what_was_not_asked():
    assert (
        choices(Model(solver="paper", lobes={"hall": 32}))[0]
        == "Each light is 32 lobes, a number that was given, as in the paper's solver."
    )
    assert choices(Model())[0] == "Shadow of surfaces on one another is not in the model."
    assert not any("split" in said for said in choices(Model(lobes={"hall": 400}, light_prior=True)))
    assert choices(Model(specular={"red": True}, tone_chosen_by={"hall": Decision(False)}))[-2:] == [
        "Every material has a specular part.", "No photo has a tone curve of its own.",
    ]  # fmt: skip
