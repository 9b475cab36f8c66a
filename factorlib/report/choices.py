"""What the solve chose of its model, and why: a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from factorlib.report.text import number, significant
from factorlib.results.materials import Decision, Model


def choices(model: Model) -> list[str]:
    """In plain sentences; the losses are those of observations that the fit did not use."""
    return [*_lights(model), *_effects(model), *_specular(model), *_tone(model)]


def _lights(model: Model) -> Iterator[str]:
    if not model.lobes:
        return
    fewest, most = min(model.lobes.values()), max(model.lobes.values())
    count = f"{most}" if fewest == most else f"{fewest} to {most}"
    if model.solver == "paper":
        yield f"Each light is {count} lobes, a number that was given, as in the paper's solver."
        return
    yield f"Each light is {count} lobes{f': {model.lobes_chosen_by}' if model.lobes_chosen_by else ''}."
    if model.light_prior and model.splitting_chosen_by:
        tries = [f"{'kept' if one.kept else 'not kept'}{_tried(one)}" for one in model.splitting_chosen_by]
        yield f"The brightest cells of each light were split: {'; then '.join(tries)}."


def _effects(model: Model) -> Iterator[str]:
    for name, part in {"Shadow of surfaces on one another": "self_shadowing",
                       "Light that surfaces send to one another": "interreflection"}.items():  # fmt: skip
        kept, losses = getattr(model, part), getattr(model, f"{part}_chosen_by")
        yield f"{name} is {'' if kept else 'not '}in the model{_losses(losses)}."


def _specular(model: Model) -> list[str]:
    without = [name for name, specular in model.specular.items() if not specular]
    every = ["Every material has a specular part."] if model.specular and not without else []
    return every + [f"{name} has no specular part{_tried(model.specular_chosen_by.get(name))}." for name in without]


def _tone(model: Model) -> list[str]:
    curves = [
        f"{photo}, exponent {number(tone.exponent, 2)}{_tried(model.tone_chosen_by.get(photo))}"
        for photo, tone in model.tone.items()
    ]
    if curves:
        return [f"Photos with a tone curve of their own, taken back by the model: {'; '.join(curves)}."]
    return ["No photo has a tone curve of its own."] if model.tone_chosen_by else []


def _tried(decision: Decision | None) -> str:
    if decision is None:
        return ""
    names = ("held_out_loss_with", "held_out_loss_without", "margin")
    return _losses({name: getattr(decision, name) for name in names})


def _losses(losses: Mapping[str, float | None]) -> str:
    with_it, without = losses.get("held_out_loss_with"), losses.get("held_out_loss_without")
    if with_it is None or without is None:
        return ""
    margin, by = losses.get("margin"), ""
    if margin is not None:
        by = f", {number(abs(margin), 1)} standard errors {'for' if margin > 0 else 'against'} it"
    return f" (held-out loss {significant(with_it)} with it, {significant(without)} without{by})"
