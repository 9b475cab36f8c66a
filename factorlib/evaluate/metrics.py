"""Why a section of metrics.json is missing, and every number of a file with its path."""

from __future__ import annotations

from collections.abc import Iterator

NO_TRUTH = "the dataset names no truth"


SECTIONS = ("materials", "relighting", "relit_set", "light", "normals", "poses")
MISSING = {
    "materials": "the truth says nothing about materials that were seen",
    "relighting": "the truth lacks materials or lights",
    "relit_set": "the truth lacks materials or lights",
    "light": "the truth names no illumination of this set",
    "normals": "the truth has no normals for these photos",
    "poses": "the truth has no poses of these objects",
}


def reasons_of(sections: dict[str, object], has_truth: bool) -> dict[str, str]:
    """Why each section that is None is.

    >>> reasons_of({"materials": None, "relighting": 1, "relit_set": 1, "light": 1, "normals": 1, "poses": 1}, False)
    {'materials': 'the dataset names no truth'}
    """
    return {name: MISSING[name] if has_truth else NO_TRUTH for name in SECTIONS if not sections[name]}


def flattened(value: object, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number of nested plain containers with its dotted path, in order.

    >>> list(flattened({"a": {"b": [1, 2.5]}, "c": None, "d": "text"}))
    [('a.b.0', 1), ('a.b.1', 2.5)]
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flattened(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple):
        for k, inner in enumerate(value):
            yield from flattened(inner, f"{path}.{k}" if path else str(k))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, value
