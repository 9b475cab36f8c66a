"""Names that become parts of paths, checked before they do: of datasets, stages and gathered files."""

from __future__ import annotations

from os import PathLike

from factorlib.errors import InputError

RESERVED = ("studies", "bench", "store", "compare")  # folders of build/ that are no datasets
LONGEST = 255  # bytes of a name, on every common file system


def check_name(name: str, kind: str, *, file: str | PathLike | None = None, key: str | None = None, reserved: tuple[str, ...] = ()) -> str:
    """`name`, where it can be the name of one file or folder and is not taken; InputError otherwise.  kind: with its article."""
    wrong = _wrong(name, reserved)
    if wrong:
        raise InputError(f"{kind} cannot be called {name!r}: {wrong}", file=file, key=key, cure="give it another name")
    return name


def _wrong(name: str, reserved: tuple[str, ...]) -> str | None:
    """
    >>> _wrong("..", ()), _wrong("a/b", ()), _wrong("it's $(one)", ())
    ('that is another folder', 'it has a slash', None)
    """
    if not name:
        return "that is no name"
    if name in (".", ".."):
        return "that is another folder"
    if "/" in name:
        return "it has a slash"
    if "\0" in name:
        return "it has a NUL"
    if name in reserved:
        return "build/ uses that name"
    try:
        length = len(name.encode())
    except UnicodeEncodeError:
        return "it is not UTF-8"
    return f"it has {length} bytes, file systems allow {LONGEST}" if length > LONGEST else None
