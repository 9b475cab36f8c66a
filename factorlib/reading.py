"""The boundary of every reader of a user's files: any failure becomes an InputError with file, key and cure.

    with reading("a mesh", path, key):          # around the calls of a parser, and only those: its exceptions are the
        scene = trimesh.load_scene(path)        #   file's fault; FAILURES names the families
    content = read_bytes(path, "a mesh", key)   # the whole of a plain file that is not too large; never a pipe or a
    device
    target = path_inside(folder, "a/b.obj")     # the path with links checked; ValueError says why it leads nowhere

Keep the `with` narrow, because it would blame the file for a defect of this project.
"""

import errno
import os
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PureWindowsPath

import msgspec

from factorlib.errors import InputError

FAILURES = (
    # OSError includes PIL.UnidentifiedImageError, ValueError includes UnicodeError and pyarrow.ArrowInvalid, and
    # RuntimeError includes RecursionError.  Pillow raises SyntaxError for a damaged PNG, and parsers raise ImportError
    # for packages that only rare files need.
    *(OSError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError, AssertionError, RuntimeError),
    *(MemoryError, EOFError, SyntaxError, BufferError, ImportError, struct.error, zlib.error, msgspec.MsgspecError),
)
TERSE = {  # words for exceptions whose own are Python's
    UnicodeDecodeError: "its text is damaged, or not UTF-8",
    struct.error: "it ends too early",
    KeyError: "it has no entry {}",
    LookupError: "it refers to an entry that it does not have",
    TypeError: "a value in it is of another kind than expected",
    AttributeError: "a value in it is of another kind than expected",
    AssertionError: "its parts contradict each other",
    RecursionError: "it is nested too deeply",
    MemoryError: "it does not fit into memory",
}
COPY_AGAIN = "the file may be incomplete, or of another format than its suffix: copy it again from its source"
MOST_BYTES = 1 << 30  # largest file that is read as a whole
MOST_WORDS = 200  # longest message of a parser, characters
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
NO_RIGHT = "give yourself the right to read it, and to enter the folders above it (chmod u+rX)"
NOT_THERE = "put it there, or correct the path"
CURES = {
    errno.EACCES: NO_RIGHT,
    errno.EPERM: NO_RIGHT,
    errno.ENOENT: NOT_THERE,
    errno.ENOTDIR: NOT_THERE,
    errno.ELOOP: "its symbolic links lead in a circle: replace one by the file itself",
    errno.ENAMETOOLONG: "a name in it is longer than file systems allow (255 bytes): shorten it",
    errno.EIO: "the disk does not give it back: copy it from elsewhere",
}


@contextmanager
def reading(
    kind: str,
    file: str | os.PathLike | None,
    key: str | None = None,
    cure: str = COPY_AGAIN,
    also: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Convert exceptions of a parser to InputError with file and key; an InputError passes unchanged.

    Args:
        kind: the kind of file with its article, as in "not readable as {kind}"
        file: the file
        key: the key that names the file
        cure: cure, unless the system's error (no permission, no such file, …) has a better one
        also: further exceptions of the parser
    """
    try:
        yield
    except InputError:
        raise
    except (*FAILURES, *also) as error:  # type: ignore[misc]
        cure = CURES.get(error.errno, cure) if isinstance(error, OSError) else cure  # type: ignore[arg-type]
        raise InputError(_fault(error, kind), file=file, key=key, cure=cure) from error


def _fault(error: BaseException, kind: str) -> str:
    """Describe an error in one line.

    >>> _fault(PermissionError(13, "Permission denied"), "a mesh")
    'cannot be read (Permission denied)'
    >>> _fault(IndexError("list index out of range"), "a mesh")
    'not readable as a mesh (it refers to an entry that it does not have)'
    >>> _fault(KeyError("frames"), "JSON"), _fault(AssertionError(), "a mesh")
    ("not readable as JSON (it has no entry 'frames')", 'not readable as a mesh (its parts contradict each other)')
    """
    if isinstance(error, OSError) and error.errno is not None and error.strerror:
        return f"cannot be read ({error.strerror})"
    words = next((words.format(error) for family, words in TERSE.items() if isinstance(error, family)), str(error))
    return f"not readable as {kind} ({one_line(words) or TERSE[AssertionError]})"


def one_line(text: str) -> str:
    r"""Return a parser's message, printable, on one line, of at most MOST_WORDS characters.

    >>> one_line("line 1\n  line\x002")
    'line 1 line?2'
    """
    flat = "".join(c if c.isprintable() else "?" for c in " ".join(text[: 8 * MOST_WORDS].split()))
    return flat if len(flat) <= MOST_WORDS else flat[: MOST_WORDS - 1] + "…"


def check_plain(file: str | os.PathLike, kind: str, key: str | None = None, most_bytes: int | None = MOST_BYTES) -> int:
    """Return the size in bytes of a plain, readable file, with links followed; nothing of it is read.

    Args:
        file: the file
        kind: the kind of file with its article, for messages
        key: the key that names the file
        most_bytes: largest size; None for any

    Raises:
        InputError: The file does not exist, is not readable, is a folder, pipe or device, or is too large.
    """
    with reading(kind, file, key):
        status = os.stat(file)
        if not stat.S_ISREG(status.st_mode):
            raise InputError(
                f"is {KINDS.get(stat.S_IFMT(status.st_mode), 'no plain file')}, not a file",
                file=file,
                key=key,
                cure=f"put {kind} there, or correct the path",
            )
        if not os.access(file, os.R_OK, effective_ids=os.access in os.supports_effective_ids):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    if most_bytes is not None and status.st_size > most_bytes:
        raise InputError(
            f"has {status.st_size / 1e6:,.1f} MB; {kind} has {most_bytes / 1e6:,.1f} MB at most",
            file=file,
            key=key,
            cure="name another file, or make this one smaller",
        )
    return status.st_size


def read_bytes(file: str | os.PathLike, kind: str, key: str | None = None, most_bytes: int = MOST_BYTES) -> bytes:
    """Read the whole content of a plain file.

    Args:
        file: the file
        kind: the kind of file with its article, for messages
        key: the key that names the file
        most_bytes: largest size

    Raises:
        InputError: As for `check_plain`.
    """
    size = check_plain(file, kind, key, most_bytes)
    with reading(kind, file, key), open(file, "rb") as stream:
        return stream.read(size)  # bounded, even if the file has grown


def read_text(file: str | os.PathLike, kind: str, key: str | None = None, most_bytes: int = MOST_BYTES) -> str:
    """Read a plain file as UTF-8 text, without a byte order mark.

    Args:
        file: the file
        kind: the kind of file with its article, for messages
        key: the key that names the file
        most_bytes: largest size

    Raises:
        InputError: As for `check_plain`, or the file is not UTF-8.
    """
    content = read_bytes(file, kind, key, most_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"not UTF-8 text (byte {error.start})", file=file, key=key, cure="save it as UTF-8") from error


def path_inside(folder: str | os.PathLike, path: str) -> Path:
    """Return the target of a path relative to a folder, with links not yet followed; it need not exist.

    Raises:
        ValueError: The path is absolute or empty, begins with a drive, leads outside the folder (links followed), or
            cannot be followed.  Causes of the last are a NUL, a name of over 255 bytes, and links in a circle.
    """
    target = Path(folder) / path
    try:
        resolved = target.resolve()
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):  # reported when the file is opened
            os.stat(target)
    except (OSError, RuntimeError, ValueError) as error:
        words = one_line(getattr(error, "strerror", None) or str(error))
        raise ValueError(f"is not a path that can be followed ({words})") from error
    drive = PureWindowsPath(path).drive and not os.path.lexists(target)
    if not path or drive or Path(path).is_absolute() or not resolved.is_relative_to(Path(folder).resolve()):
        raise ValueError("leads outside the dataset")
    return target
