"""What the solve chose of its model, and why: a sentence each."""

from __future__ import annotations

from collections.abc import Mapping

from factorlib.report.text import number, significant
from factorlib.results.materials import Decision, Model

WITH, WITHOUT, MARGIN = "held_out_loss_with", "held_out_loss_without", "margin"


def choices(model: Model) -> list[str]:
    """In plain sentences; the losses are those of observations that the fit did not use."""
    return [*_lights(model), *_effects(model), *_specular(model), *_tone(model)]


def _lights(model: Model) -> list[str]:
    if not model.lobes:
        return []
    fewest, most = min(model.lobes.values()), max(model.lobes.values())
    count = f"{most}" if fewest == most else f"{fewest} to {most}"
    if model.solver == "paper":
        return [f"Each light is {count} lobes, a number that was given, as in the paper's solver."]
    found = [f"Each light is {count} lobes: {model.lobes_chosen_by}."] if model.lobes_chosen_by else [f"Each light is {count} lobes."]
    if not model.light_prior:
        return found
    splittings = [f"{'kept' if one.kept else 'not kept'}{_tried(one)}" for one in model.splitting_chosen_by]
    return [*found, *([f"The brightest cells of each light were split: {'; then '.join(splittings)}."] if splittings else [])]


def _effects(model: Model) -> list[str]:
    return [
        _kept("Shadow of surfaces on one another", model.self_shadowing, model.self_shadowing_chosen_by),
        _kept("Light that surfaces send to one another", model.interreflection, model.interreflection_chosen_by),
    ]


def _kept(name: str, kept: bool, losses: Mapping[str, float]) -> str:
    return f"{name} is {'' if kept else 'not '}in the model{_losses(losses.get(WITH), losses.get(WITHOUT), losses.get(MARGIN))}."


def _losses(with_it: float | None, without: float | None, margin: float | None) -> str:
    if with_it is None or without is None:
        return ""
    by = "" if margin is None else f", {number(abs(margin), 1)} standard errors {'for' if margin > 0 else 'against'} it"
    return f" (held-out loss {significant(with_it)} with it, {significant(without)} without{by})"


def _specular(model: Model) -> list[str]:
    found = []
    for name, specular in model.specular.items():
        if not specular:
            found.append(f"{name} has no specular part{_tried(model.specular_chosen_by.get(name))}.")
    if model.specular and not found:
        found.append("Every material has a specular part.")
    return found


def _tone(model: Model) -> list[str]:
    curves = [f"{photo}, exponent {number(tone.exponent, 2)}{_tried(model.tone_chosen_by.get(photo))}" for photo, tone in model.tone.items()]
    if curves:
        return [f"Photos with a tone curve of their own, taken back by the model: {'; '.join(curves)}."]
    return ["No photo has a tone curve of its own."] if model.tone_chosen_by else []


def _tried(decision: Decision | None) -> str:
    return "" if decision is None else _losses(decision.held_out_loss_with, decision.held_out_loss_without, decision.margin)
