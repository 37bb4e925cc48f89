"""Formats whose logs are folders of files: the base of their readers, and the files of a sensor."""

from __future__ import annotations

import abc
from pathlib import Path

from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip

NAMES_SHOWN = 12


class FolderReader(abc.ABC):
    """Reads the folder of a log, or one above that holds a single log (``types.LogReader``).

    Attributes:
        name: of the format.
        description: for messages.
        noun: several logs of the format, for messages.
    """

    name: str
    description: str
    noun: str

    def can_open(self, path: Path) -> bool:
        """Whether it is a log, or a folder with logs."""
        return bool(self.logs(path))

    def open(self, path: Path) -> Clip:
        """The log as a clip.

        Raises:
            ClipError: a file or a value is missing or wrong, or there are several logs.
        """
        found = self.logs(path)
        if not found:
            raise ClipError(f"holds no {self.noun}; give {self.description}")
        if len(found) > 1:
            names = [str(each.relative_to(path)) for each in found[:NAMES_SHOWN]]
            more = f" and {len(found) - NAMES_SHOWN} more" if len(found) > NAMES_SHOWN else ""
            raise ClipError(f"holds {len(found)} {self.noun}; give the folder of one: {names}{more}")
        return self.read(found[0].resolve())

    def files(self, path: Path) -> list[Path]:
        """What a log depends on: its folder, and the files for it outside of it."""
        return [path, *(file for log in self.logs(path) for file in self.beside(log.resolve()) if file.exists())]

    def beside(self, log: Path) -> list[Path]:
        """Files outside of one of ``logs`` that it depends on, whether they exist or not; none by default."""
        return []

    @abc.abstractmethod
    def logs(self, path: Path) -> list[Path]:
        """Folders (or main files) of logs: the path itself, or those below it, sorted."""

    @abc.abstractmethod
    def read(self, log: Path) -> Clip:
        """The clip in one of ``logs``; errors as for ``open``."""


def numbered_files(root: Path, folder: str, suffix: str) -> dict[int, str]:
    """Names below ``root`` of files in a folder by the number that is their name, in its order."""
    files = [each for each in (root / folder).glob(f"*{suffix}") if each.stem.isascii() and each.stem.isdigit()]
    return {int(each.stem): f"{folder}/{each.name}" for each in sorted(files, key=lambda file: int(file.stem))}
