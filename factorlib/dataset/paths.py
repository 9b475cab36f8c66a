"""Checks of keys in a file that a user writes: known names, rotations, and paths that stay in the dataset's folder.

Links are followed before a path is checked.
"""

import os
import stat
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, NoReturn

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain, path_inside, reading

ROTATION_TOLERANCE = 1e-3  # largest entry of RᵀR − 1, which matrices typed with four digits satisfy


def labelmap_beside(masks: str, folder: Path) -> str | None:
    """Return the labelmap.txt in the folder of a mask or in the one above, both below the dataset's `folder`."""
    names = [str(above / "labelmap.txt") for above in PurePosixPath(masks).parents if above.name][:2]
    return next((name for name in names if (folder / name).is_file()), None)


def plain_path(path: str | PurePath) -> PurePosixPath:
    """Return a path as programs write it, with slashes for backslashes and composed letters (Unicode's NFC)."""
    return PurePosixPath(unicodedata.normalize("NFC", str(path).replace("\\", "/")))


def path_on_disk(folder: Path, path: str) -> str:
    """Return a path with slashes for backslashes, in the Unicode form (NFC or NFD) that the disk has.

    Args:
        folder: folder that the path is relative to
        path: the path, which may not exist
    """
    slashed = path.replace("\\", "/")
    forms = [path, slashed, *(unicodedata.normalize(form, slashed) for form in ("NFC", "NFD"))]
    return next((form for form in forms if os.path.lexists(folder / form)), slashed)


def nearest_paths(path: PurePath, others: Sequence[PurePosixPath]) -> list[PurePosixPath]:
    """Return those of the other paths that share the most folders with a path, and then its name: all, if none does."""
    folders = set(path.parent.parts)
    shared = [2 * len(folders.intersection(other.parent.parts)) + (other.name == path.name) for other in others]
    return [other for other, count in zip(others, shared) if count == max(shared)]


class Refusal:
    """Checker of the keys of one file: calling it, or a method, raises InputError for a key.

    Attributes:
        file: the file, for errors
        folder: the folder that must contain its paths
    """

    def __init__(self, file: Path, folder: Path):
        self.file = file
        self.folder = folder
        self.faults: list[InputError] = []
        self.inside: dict[str, Path] = {}  # resolved folders inside `folder`, by their paths as written

    def __call__(self, key: str, fault: str, cure: str) -> NoReturn:
        """Raise InputError for a key, with a fault and its cure."""
        raise InputError(fault, file=self.file, key=key, cure=cure)

    def refuse_if(self, condition: object, key: str, fault: str, cure: str) -> None:
        """Raise InputError for a key if a condition is true.

        Args:
            condition: the condition
            key: the key
            fault: what is wrong
            cure: what to do
        """
        if condition:
            self(key, fault, cure)

    def collect(self, check: Callable[..., None], *arguments: Any) -> None:
        """Call a check, and add its InputError, if any, to `faults`, so that checking continues."""
        try:
            check(*arguments)
        except InputError as error:
            self.faults.append(error)

    def check_known(self, key: str, name: str, known: Iterable[str], kind: str) -> None:
        """Check that a name is among the known ones; the error suggests the nearest one.

        Args:
            key: the key with the name
            name: the name
            known: the known names
            kind: the kind of name, for errors
        """
        if name not in (known := list(known)):
            self(
                key,
                f"unknown {kind} {name!r}",
                (did_you_mean(name, known) if known else f"the dataset has no {kind} here"),
            )

    def check_distinct(self, key: str, names: Iterable[str], kind: str) -> None:
        """Check that the names of a list are distinct.

        Args:
            key: the key of the list
            names: its names
            kind: the kind of name, for errors
        """
        first: dict[str, int] = {}
        for index, name in enumerate(names):
            self.refuse_if(
                first.setdefault(name, index) != index,
                f"{key}[{index}].name",
                f"duplicate {kind} name {name!r}",
                f"{key}[{first[name]}] has it already: rename one",
            )

    def check_rotation(self, key: str, rows: tuple) -> None:
        """Check that three rows are a rotation: RᵀR = 1 within ROTATION_TOLERANCE, determinant +1."""
        gram = [[sum(r[i] * r[j] for r in rows) - (i == j) for j in range(3)] for i in range(3)]
        worst = max(abs(entry) for row in gram for entry in row)
        self.refuse_if(
            not worst <= ROTATION_TOLERANCE,
            key,
            f"not a rotation: RᵀR differs from 1 by {worst:.3g}",
            "its columns must be unit vectors at right angles (no scale)",
        )
        a, b, c = rows
        self.refuse_if(
            sum(a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3]) for i in range(3)) < 0,
            key,
            "not a rotation but a reflection (determinant −1)",
            "one axis is flipped: the camera frame is x right, y down, z forward",
        )

    def check_path(self, key: str, path: str, suffixes: Iterable[str], must_exist: bool = True) -> None:
        """Check that a path has a known suffix and leads to a plain, readable file inside the folder.

        Args:
            key: the key with the path
            path: the path
            suffixes: the known suffixes
            must_exist: require that the file exists
        """
        target = self._resolve(key, path, "file")
        self.refuse_if(
            target.suffix.lower() not in suffixes,
            key,
            f"{path!r} has a suffix that is not read here",
            f"expected one of {', '.join(suffixes)}"
            + ("; of a Cryptomatte, export the matte of each material" if target.suffix.lower() == ".exr" else ""),
        )
        if file_exists(target, key):
            self._check_plain(key, path, target)
        elif must_exist:
            try:
                names = [entry.name for entry in target.parent.iterdir() if entry.is_file()]
            except OSError:
                names = []
            cure = did_you_mean(target.name, names)
            if not cure.startswith("did"):
                cure = f"put it at {target}, or correct the path" + "; `make label` draws it" * key.endswith(".masks")
            self(key, f"there is no file {path!r}", cure)

    def check_subfolder(self, key: str, path: str) -> None:
        """Check that a path leads to a readable folder inside the dataset's, with links followed."""
        folder = self._resolve(key, path, "folder")
        with reading("a folder", self.file, key):
            self.refuse_if(
                not folder.is_dir(), key, f"there is no folder {path!r}", "copy it there, or correct the path"
            )
            os.scandir(folder).close()

    def file_in(self, key: str, folder: str, name: str) -> Path | None:
        """Return the path of a file in a folder inside the dataset's; None if it does not exist.

        Args:
            key: the key with the folder
            folder: the folder
            name: name of the file, which may not lead outside either
        """
        target = self._resolve(key, f"{folder}/{name}", "file")
        if not file_exists(target, key):
            return None
        self._check_plain(key, f"{folder}/{name}", target)
        return target

    def _check_plain(self, key: str, path: str, target: Path) -> None:
        try:
            check_plain(target, "a file", key, most_bytes=None)
        except InputError as error:
            self(key, f"{path!r} {error.fault}", error.cure or "correct the path")

    def _resolve(self, key: str, path: str, kind: str) -> Path:
        """Return the path with links followed, which must stay in the folder.

        A folder with plain files is resolved once, because a set may have thousands of them.
        """
        above, _, name = path.rpartition("/")
        plain_name = name not in ("", ".", "..")
        with suppress(OSError, ValueError):  # reported below
            if plain_name and above in self.inside and stat.S_ISREG(os.lstat(self.inside[above] / name).st_mode):
                return self.inside[above] / name
        try:
            target = path_inside(self.folder, path)
            if above and plain_name:
                self.inside[above] = path_inside(self.folder, above)
            return target
        except ValueError as error:
            self(
                key,
                f"{path if len(path) <= 80 else f'{path[:80]}…'!r} {error}",
                f"copy the {kind} into {self.folder.resolve()} and name it relative to that folder",
            )


def file_exists(target: Path, key: str) -> bool:
    """Return True if the path exists; InputError if that cannot be determined."""
    with reading("a file", target, key):
        try:
            os.stat(target)
        except (FileNotFoundError, NotADirectoryError):
            return False
    return True
