"""A plan, and what else there is to tell, in words: what each verb prints."""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import Any

import msgspec
from msgspec import inspect as types

from factorlib.runner.plan import Planned, Step, in_short

SHOWN = 8  # reasons of one step that are written out
NAMED = 20  # steps that have failed


def plan_lines(planned: list[Planned], every_reason: bool = False) -> list[str]:
    """What would run, one line for steps of a stage that share their reasons, the photo's own name aside.

    every_reason: below it, a line each
    """
    groups: dict[tuple, list[Step]] = {}
    for p in (p for p in planned if p.status != "current"):
        reasons = tuple(_of_any_photo(reason, p.step) for reason in p.reasons)
        groups.setdefault((p.step.stage, p.status, reasons), []).append(p.step)
    lines = []
    for (stage, status, reasons), steps in groups.items():
        names = [step.of for step in steps if step.of]
        items = ", ".join(names) if len(names) <= 3 else f"{len(names)} {'recipes' if steps[0].recipe else 'photos'}"
        in_line = "" if every_reason else in_short(reasons, SHOWN)
        lines.append(f"{stage:<10} {status:<7} {items:<24} {in_line}".rstrip())
        lines += [f"    {reason}" for reason in reasons] if every_reason else []
    current = sum(p.status == "current" for p in planned)
    return [*lines, f"{current} of {len(planned)} steps are current" if lines else f"all {current} steps are current"]


def _of_any_photo(reason: str, step: Step) -> str:
    """`masks/kitchen` is `masks` to the step of the kitchen, `photos.kitchen.image` is `photos.*.image`.

    >>> _of_any_photo("if masks/kitchen, train comes out different", Step("align", "kitchen"))
    'if masks, train comes out different'
    """
    if step.photo and reason.startswith(("if ", "result of ")):
        return reason.replace(f"/{step.photo}", "")
    if step.photo and reason.startswith("dataset.yaml:"):
        return reason.replace(f" photos.{step.photo}.", " photos.*.", 1)
    return reason


def count(items: list, one: str = "step") -> str:
    """
    >>> count(["a"]), count(["a", "b"], "fault")
    ('1 step', '2 faults')
    """
    return f"{len(items)} {one}{'' if len(items) == 1 else 's'}"


def log_lines(logged: list[tuple[Planned, list[dict], str | None]]) -> list[str]:
    """What each step cost and warned of; what all were made with, and where a step was made with another version, that.

    logged: steps with the events of their results' logs, and the file that says by which defect one failed
    """
    made = [_made_with(p.record or {}, events) if p.status == "current" else {} for p, events, _ in logged]
    versions: dict[str, list[str]] = {}
    for name, version in (pair for own in made for pair in own.items()):
        versions.setdefault(name, []).append(version)
    most = {name: max(versions[name], key=versions[name].count) for name in sorted(versions, key=str.lower)}
    lines = []
    for (planned, events, failed), own in zip(logged, made, strict=True):
        lines.append(f"{planned.step!s:<26} {_cost(planned, events)}".rstrip())
        lines += _listed("with ", {name: version for name, version in own.items() if version != most[name]})
        lines += [f"    warning: {event['text']}" for event in events if event["event"] == "warning"]
        lines += [f"    it failed by a defect of the program: {failed}"] if failed else []
    return lines + _listed("made with ", most)


def _listed(words: str, versions: dict[str, str]) -> list[str]:
    text = words + ", ".join(f"{name}\N{NO-BREAK SPACE}{version}" for name, version in versions.items())
    parts = textwrap.wrap(text, 110, initial_indent="    ", subsequent_indent="    ") if versions else []
    return [part.replace("\N{NO-BREAK SPACE}", " ") for part in parts]


def _cost(planned: Planned, events: list[dict]) -> str:
    done = next((event for event in reversed(events) if event["event"] == "done"), None)
    if planned.status != "current":
        return f"{planned.status}: {in_short(planned.reasons, SHOWN)}"
    if done is None:
        return "its log is not there"
    cores = f"{done['threads']} thread{'s' * (done['threads'] > 1)} on {done['cores']} core{'s' * (done['cores'] > 1)}"
    cost = f"{done['seconds']:8.1f} s {done['cpu_seconds']:8.1f} s processor {done['memory_mb']:7.0f} MB peak"
    return f"{cost}   {cores}   {done['started'][:16].replace('T', ' ')} UTC"


def _made_with(record: dict, events: list[dict]) -> dict[str, str]:
    """The versions of Python and of the packages that count, and the machine's kind."""
    machine = next((event["machine"] for event in reversed(events) if "machine" in event), {})
    made = {"Python": machine.get("python", record.get("python", ""))}
    made |= {machine["system"]: machine["processor"]} if machine else {}
    return made | {n.removeprefix("package:"): v for n, v in record.items() if n.startswith("package:")}


def parameters(params: type) -> list[tuple[str, str, str, str]]:
    """The fields of a stage's `Params`, in its order: name, what is allowed, default as YAML has it, meaning.

    The meaning is the string that follows a field.  One that is a struct stands for its own fields, with dotted names.
    """
    texts, table = {}, []
    for cls in reversed(params.__mro__):
        if issubclass(cls, msgspec.Struct) and cls is not msgspec.Struct:
            body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
            for field, text in zip(body, body[1:]):
                match field, text:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(said)):
                        texts[name] = " ".join(str(said).split())
    for field in types.type_info(params).fields:
        if isinstance(field.type, types.StructType):
            table += [(f"{field.name}.{name}", *rest) for name, *rest in parameters(field.type.cls)]
        else:
            made = field.default is msgspec.NODEFAULT and callable(field.default_factory)
            value = field.default_factory() if made else field.default
            text = "none" if value is msgspec.NODEFAULT else msgspec.json.encode(value).decode().replace(",", ", ")
            table.append((field.name, allowed(field.type), text, texts.get(field.name, "")))
    return table


def allowed(of: Any) -> str:
    """What a value of a type, as `msgspec.inspect` has it, may be.

    >>> allowed(types.type_info(int)), allowed(types.IntType(ge=1, le=1024)), allowed(types.FloatType(gt=0))
    ('whole number', '1 … 1,024', 'number > 0')
    """
    if isinstance(of, types.IntType | types.FloatType):
        if of.ge is not None and of.le is not None:
            return f"{of.ge:,} … {of.le:,}"
        bounds = ((">", of.gt), ("≥", of.ge), ("<", of.lt), ("≤", of.le))
        words = " and ".join(f"{sign} {bound:,}" for sign, bound in bounds if bound is not None)
        return f"{'whole number' if isinstance(of, types.IntType) else 'number'} {words}".strip()
    if isinstance(of, types.LiteralType):
        return ", ".join(str(value) for value in sorted(of.values, key=str))
    if isinstance(of, types.UnionType):
        return " or ".join(map(allowed, of.types))
    if items := getattr(of, "item_types", None):
        return f"{len(items)} of: {allowed(items[0])}"
    words = {types.BoolType: "true, false", types.StrType: "text", types.NoneType: "null"}
    return words.get(type(of), type(of).__name__)
