"""The benchmark's plots: time against error, and error by what was asked."""

from __future__ import annotations

import math

from benchmarks.figure import COLOURS, LogAxis, dot, line, page, path, text

REFERENCE_COLOUR = COLOURS[-1]
QUANTITIES = ("roughness", "sharpness", "cosine of the view", "degrees from the mirror direction")


def colour_of(label: str, labels: list[str]) -> str:
    """One for all variants of an operator."""
    names = list(dict.fromkeys(other.split()[0] for other in labels if not other.startswith("reference")))
    return REFERENCE_COLOUR if label.startswith("reference") else COLOURS[names.index(label.split()[0])]


def name_of(label: str) -> str:
    return label.split()[0].replace("_", " ")


def variant_of(label: str) -> str:
    """What distinguishes it from others of its colour: precision and path, or the tolerance of the reference."""
    return " ".join(label.split()[1:]).replace("float", "f")


def time_against_error(operators: dict[str, dict]) -> str:
    """Median (full) and p95 (hollow) of the specular error over the time of value and gradients; log-log."""
    shown = {label: row for label, row in operators.items() if "specular" in row}
    times = {label: row["microseconds"]["values_and_gradients"]["median"] for label, row in shown.items()}
    errors = {label: (max(row["specular"]["median"], 1e-8), row["specular"]["p95"]) for label, row in shown.items()}
    flat = [e for pair in errors.values() for e in pair]
    across = LogAxis(0.5 * min(times.values()), 2 * max(times.values()), 84, 740)
    up = LogAxis(10 ** math.floor(math.log10(min(flat)) - 0.3), 10 ** math.ceil(math.log10(max(flat))), 410, 66)
    parts = [
        text(20, 22, "Time and error of the specular reflection of one lobe at one point", css="title"),
        *_legend(shown, list(operators)),
    ]
    parts += axes(across, up, "value and all gradients, µs of one core per evaluation", "error |R − S| / (S + E/100)")
    for label, (median, p95) in errors.items():
        x, colour = across(times[label]), colour_of(label, list(operators))
        parts += [
            path([(x, up(median)), (x, up(p95))], colour),
            dot(x, up(p95), colour, hollow=True),
            dot(x, up(median), colour),
        ]
        parts.append(text(x, up(median) + 19, variant_of(label), "middle", "small"))
    return page(760, 456, parts)


def _legend(shown: dict[str, dict], labels: list[str], y: float = 44) -> list[str]:
    """Colours of operators, and what full and hollow mean."""
    first = {name_of(label): label for label in reversed(shown)}
    parts = [text(740, y - 22, "full: median, hollow: p95", "end", "soft")]
    for k, label in enumerate(dict.fromkeys(first[name_of(other)] for other in shown)):
        words = name_of(label) + (", by its tolerance" if label.startswith("reference") else "")
        parts += [dot(90 + 110 * k, y - 4, colour_of(label, labels)), text(100 + 110 * k, y, words)]
    return parts


def axes(across: LogAxis, up: LogAxis, x_label: str, y_label: str) -> list[str]:
    parts = []
    for value in up.decades():
        parts += [
            line(across.start, up(value), across.end, up(value), "grid"),
            text(across.start - 8, up(value) + 4, percent(value), "end", "soft small"),
        ]
    for value in across.decades():
        parts += [
            line(across(value), up.start, across(value), up.end, "grid"),
            text(across(value), up.start + 16, f"{value:g}", "middle", "soft small"),
        ]
    parts.append(line(across.start, up.start, across.end, up.start, "axis"))
    middle = (up.start + up.end) / 2
    return [
        *parts,
        text((across.start + across.end) / 2, up.start + 34, x_label, "middle"),
        text(18, middle, y_label, "middle", turn=-90),
    ]


def percent(value: float) -> str:
    return (
        f"{100 * value:g} %"
        if value >= 0.99e-4
        else f"10{str(round(math.log10(value)) + 2).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))} %"
    )


def errors_by_input(operators: dict[str, dict]) -> str:
    """A panel per quantity: median (full) and p95 (hollow, dashed) of the specular error in its bins, of each float32 operator."""
    shown = {
        label: row["specular"] for label, row in operators.items() if label.endswith("float32") and "specular" in row
    }
    values = [
        b[q]
        for table in shown.values()
        for quantity in QUANTITIES
        for b in table[quantity].values()
        for q in ("median", "p95")
    ]
    low, high = 10 ** math.floor(math.log10(min(values))), 10 ** math.ceil(math.log10(max(values)))
    parts = [text(20, 22, "Error of the specular reflection by what is asked: |R − S| / (S + E/100)", css="title")]
    for k, quantity in enumerate(QUANTITIES):
        left, top = 66 + 375 * (k % 2), 90 + 218 * (k // 2)
        parts += _panel(shown, quantity, LogAxis(low, high, top + 150, top), left, list(operators))
    return page(760, 504, [*parts, *_legend(shown, list(operators))])


def _panel(shown: dict[str, dict], quantity: str, up: LogAxis, left: float, labels: list[str]) -> list[str]:
    bins = list(next(iter(shown.values()))[quantity])
    parts = [text(left, up.end - 10, quantity, css="title")]
    for value in up.decades():
        parts += [
            line(left, up(value), left + 300, up(value), "grid"),
            text(left - 8, up(value) + 4, percent(value), "end", "soft small"),
        ]
    parts.append(line(left, up.start, left + 300, up.start, "axis"))
    middles = [left + 300 * (k + 0.5) / len(bins) for k in range(len(bins))]
    parts += [
        text(x, up.start + 16, name.replace(" to ", "–"), "middle", "soft small")
        for x, name in zip(middles, bins, strict=True)
    ]
    for label, table in shown.items():
        colour = colour_of(label, labels)
        for measure, hollow in (("p95", True), ("median", False)):
            points = [(x, up(table[quantity][name][measure])) for x, name in zip(middles, bins, strict=True)]
            parts += [
                path(points, colour, dashed=hollow),
                *(dot(x, y, colour, hollow=hollow, radius=3) for x, y in points),
            ]
    return parts
