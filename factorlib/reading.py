"""The boundary of every reader of a user's files: whatever goes wrong within becomes an InputError with file, key and cure.

A parser raises whatever its authors thought of.  Here that is said once, in three layers:

    with reading("a mesh", path, key):          # around the calls of a parser, and only those: what it raises is the
        scene = trimesh.load_scene(path)        #   file's fault; FAILURES names the families
    content = read_bytes(path, "a mesh", key)   # the whole of a plain file that is not too large; never a pipe or a device
    target = path_inside(folder, "a/b.obj")     # where a path leads, links followed; ValueError says why it leads nowhere

Keep the `with` narrow: a mistake of this project inside it would be blamed on the file.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec

from factorlib.errors import InputError

FAILURES = (
    OSError,  # also PIL.UnidentifiedImageError
    ValueError,  # also UnicodeError, json.JSONDecodeError, pyarrow.ArrowInvalid
    ArithmeticError,  # a division by zero, a number too large
    LookupError,
    TypeError,
    AttributeError,
    AssertionError,
    RuntimeError,  # also RecursionError, a loop of links in pathlib
    MemoryError,
    EOFError,
    SyntaxError,  # Pillow's word for a damaged PNG
    BufferError,
    ImportError,  # a parser that asks for a package only for odd files
    struct.error,
    zlib.error,
    msgspec.MsgspecError,
)
COPY_AGAIN = "is it whole, and of the kind its suffix says? copy it again from where it came"
MOST_BYTES = 1 << 30  # of a file that is read as a whole
MOST_WORDS = 200  # characters of a parser's message
KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
CURES = {
    errno.EACCES: "give yourself the right to read it, and to enter the folders above it (chmod u+rX)",
    errno.EPERM: "give yourself the right to read it, and to enter the folders above it (chmod u+rX)",
    errno.ENOENT: "put it there, or correct the path",
    errno.ENOTDIR: "put it there, or correct the path",
    errno.ELOOP: "its symbolic links lead in a circle: replace one by the file itself",
    errno.ENAMETOOLONG: "a name in it is longer than file systems allow (255 bytes): shorten it",
    errno.EIO: "the disk does not give it back: copy it from elsewhere",
}


@contextmanager
def reading(
    what: str,
    file: str | os.PathLike | None,
    key: str | None = None,
    cure: str = COPY_AGAIN,
    also: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Whatever a parser raises within is raised as an InputError that names file and key; an InputError passes as it is.

    what: what the file should be, as in "not readable as {what}", with its article;  cure: unless the system's own
    complaint (no right to read, no such file, …) has a better one;  also: what else the parser raises, of its own
    """
    try:
        yield
    except InputError:
        raise
    except (*FAILURES, *also) as error:
        raise InputError(found_in(error, what), file=file, key=key, cure=cure_of(error, cure)) from error


def found_in(error: BaseException, what: str) -> str:
    """What went wrong, in one line.

    >>> found_in(PermissionError(13, "Permission denied"), "a mesh")
    'cannot be read (Permission denied)'
    >>> found_in(IndexError("list index out of range"), "a mesh")
    'not readable as a mesh (IndexError: list index out of range)'
    """
    if isinstance(error, RecursionError):
        return f"not readable as {what}: it is nested too deeply"
    if isinstance(error, MemoryError):
        return f"not readable as {what}: it does not fit into memory"
    if isinstance(error, OSError) and error.errno is not None and error.strerror:
        return f"cannot be read ({error.strerror})"
    words = one_line(str(error))
    needs_type = (
        isinstance(error, (LookupError, TypeError, AttributeError, AssertionError)) or not words
    )  # says little without its name
    said = ": ".join(part for part in (type(error).__name__ if needs_type else "", words) if part)
    return f"not readable as {what} ({said})"


def cure_of(error: BaseException, otherwise: str) -> str:
    """The cure for an OSError of a known kind; `otherwise` for any other error."""
    return CURES.get(error.errno, otherwise) if isinstance(error, OSError) and error.errno is not None else otherwise


def one_line(text: str) -> str:
    """A parser's words, printable, on one line, of at most MOST_WORDS characters.

    >>> one_line("line 1\\n  line\\x002")
    'line 1 line?2'
    """
    flat = "".join(c if c.isprintable() else "?" for c in " ".join(text[: 8 * MOST_WORDS].split()))
    return flat if len(flat) <= MOST_WORDS else flat[: MOST_WORDS - 1] + "…"


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def check_plain(file: str | os.PathLike, what: str, key: str | None = None, most_bytes: int | None = MOST_BYTES) -> int:
    """The size in bytes of a plain file, links followed, that can be opened; nothing of it is read.

    Raises InputError for what is not there or may not be read, for folders, pipes and devices, which would never end,
    and for a file of more than `most_bytes`; None: of any size.
    """
    with reading(what, file, key):
        found = os.stat(file)
        if not stat.S_ISREG(found.st_mode):
            kind = next((name for test, name in KINDS if test(found.st_mode)), "no plain file")
            raise InputError(
                f"is {kind}, not a file", file=file, key=key, cure=f"put {what} there, or correct the path"
            )
        if not os.access(file, os.R_OK, effective_ids=os.access in os.supports_effective_ids):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    if most_bytes is not None and found.st_size > most_bytes:
        words = f"has {megabytes(found.st_size)}; {what} has {megabytes(most_bytes)} at most"
        raise InputError(words, file=file, key=key, cure="is it the right file?")
    return found.st_size


def read_bytes(file: str | os.PathLike, what: str, key: str | None = None, most_bytes: int = MOST_BYTES) -> bytes:
    """The content of a plain file of at most `most_bytes`; InputError as in `check_plain`."""
    size = check_plain(file, what, key, most_bytes)
    with reading(what, file, key), open(file, "rb") as stream:
        return stream.read(size)  # so much memory is taken at once, whatever the file holds


def read_text(file: str | os.PathLike, what: str, key: str | None = None, most_bytes: int = MOST_BYTES) -> str:
    """The same as UTF-8 text, without a byte order mark."""
    content = read_bytes(file, what, key, most_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"not UTF-8 text (byte {error.start})", file=file, key=key, cure="save it as UTF-8") from error


def megabytes(count: int) -> str:
    """
    >>> megabytes(12_345_678_000)
    '12,345.7 MB'
    """
    return f"{count / 1e6:,.1f} MB"


# ── paths ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def path_inside(folder: str | os.PathLike, path: str) -> Path:
    """Where a path that is written relative to `folder` leads, links not yet followed; it need not exist.

    Raises ValueError, whose words say what is wrong with it, for a path that leads outside the folder (links followed), an
    absolute or empty one, and one that no file system can follow: with a NUL, a name of over 255 bytes, or links in a circle.
    """
    if not path or Path(path).is_absolute():
        raise ValueError("leads outside the dataset")
    target = Path(folder) / path
    try:
        where = target.resolve()
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):  # for whoever opens it to say
            os.stat(target)
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"is no path that can be followed ({one_line(getattr(error, 'strerror', None) or str(error))})"
        ) from error
    if not where.is_relative_to(Path(folder).resolve()):
        raise ValueError("leads outside the dataset")
    return target
