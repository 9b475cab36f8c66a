"""Entries of the matrix of materials × lights, as a case sees them: what cases of all worlds have in common."""

from __future__ import annotations

from typing import ClassVar

import msgspec

Entry = tuple[int, int]  # a material and a light


class Entries(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is seen of the world that a seed names.

    names:    of the materials of every world, in the order of their numbers
    entries:  observed ones
    """

    names: ClassVar[tuple[str, ...]]

    seed: int
    entries: tuple[Entry, ...]

    @property
    def materials(self) -> list[int]:
        """Those that are seen, in order."""
        return sorted({m for m, _ in self.entries})

    @property
    def material_names(self) -> list[str]:
        """The same by name, in the order of their numbers in the case's observations."""
        return [self.names[m] for m in self.materials]

    @property
    def lights(self) -> list[int]:
        """Those that are seen, in order."""
        return sorted({li for _, li in self.entries})

    def names_in(self, light: int) -> list[str]:
        """Of the materials that are seen in a light."""
        return [self.names[m] for m, at in self.entries if at == light]
