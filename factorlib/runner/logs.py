"""Logs, a JSON object on each line; a line that is damaged costs that line, and is said."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import msgspec

log = logging.getLogger("factorlib.runner")


class _Event(msgspec.Struct):
    """What every line has; the rest of it depends on the event."""

    event: str


def sound_lines(path: Path) -> list[bytes]:
    """The lines of a log that are events, in order; none where there is no log."""
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return []
    sound = [line for line in lines if _is_event(line)]
    if len(sound) < len(lines):
        log.warning("%s: %d damaged lines are left out; the results are not affected", path, len(lines) - len(sound))
    return sound


def warnings_in(path: Path) -> list[str]:
    """What a step warned of."""
    events: list[dict[str, Any]] = [msgspec.json.decode(line) for line in sound_lines(path) if b"warning" in line]
    return [str(event.get("text", "")) for event in events if event["event"] == "warning"]


def _is_event(line: bytes) -> bool:
    try:
        msgspec.json.decode(line, type=_Event)
        msgspec.json.decode(line)
        return True
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return False
