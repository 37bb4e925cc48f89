"""Folders of logs: the one that was meant, and the files of a sensor in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nurec_sim.errors import ClipError

NAMES_SHOWN = 12


def only_one(path: Path, found: Sequence[Path], noun: str) -> Path:
    """The only folder of a kind at or below a path.

    Raises:
        ClipError: there is none, or there are several; the text names them.
    """
    if len(found) != 1:
        names = [str(each.relative_to(path)) for each in found[:NAMES_SHOWN]]
        more = f" and {len(found) - NAMES_SHOWN} more" if len(found) > NAMES_SHOWN else ""
        raise ClipError(f"holds {len(found)} {noun}; give the folder of one: {names}{more}")
    return found[0].resolve()


def numbered_files(root: Path, folder: str, suffix: str) -> dict[int, str]:
    """Names below ``root`` of files in a folder by the number that is their name, in its order."""
    files = [each for each in (root / folder).glob(f"*{suffix}") if each.stem.isascii() and each.stem.isdigit()]
    return {int(each.stem): f"{folder}/{each.name}" for each in sorted(files, key=lambda file: int(file.stem))}
