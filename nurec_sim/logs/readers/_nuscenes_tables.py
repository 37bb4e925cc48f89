"""The tables of nuScenes: JSON lists of flat records, of which one scene needs few.

The tables of ``v1.0-trainval`` take gigabytes, so that the large ones are searched, not parsed: each of their records
is one object without others in it.
"""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs import fields
from nurec_sim.logs.storage import parsed_json

Row = dict[str, Any]
LONGEST_RECORD = 1 << 16


def small_table(folder: Path, name: str) -> dict[str, Row]:
    """A table that is read as a whole, by token.

    Raises:
        ClipError: it is missing, or no list of records.
    """
    path = _existing(folder, name)
    if path.stat().st_size > LIMITS.json_bytes:
        raise ClipError(f"{path.name} has {path.stat().st_size:,} bytes; at most {LIMITS.json_bytes:,} are read")
    rows: list[Row] = parsed_json(path.read_bytes(), path.name, list, "a list of records")
    return {fields.of_kind(f"{path.name}: record {n}", row, "token", str): row for n, row in enumerate(rows)}


def matching_rows(folder: Path, name: str, key: str, wanted: Callable[[str], bool]) -> Iterator[Row]:
    """Records of a large table whose text ``key`` is wanted, in the order of the file.

    Raises:
        ClipError: the table is missing or empty, or a wanted record is not JSON.
    """
    path = _existing(folder, name)
    if not path.stat().st_size:
        raise ClipError(f"{path.name} is empty")
    pattern = re.compile(rb'"%s"\s*:\s*"([^"]*)"' % re.escape(key.encode()))
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
        for found in pattern.finditer(text):
            if not wanted(found[1].decode("utf-8", "replace")):
                continue
            start = text.rfind(b"{", max(0, found.start() - LONGEST_RECORD), found.start())
            end = text.find(b"}", found.end(), found.end() + LONGEST_RECORD)
            try:
                row = json.loads(text[start : end + 1]) if min(start, end) >= 0 else None
            except (ValueError, RecursionError):
                row = None
            if not isinstance(row, dict):
                raise ClipError(f"{path.name}: the record around byte {found.start()} is not a JSON object")
            yield row


def reference(table: dict[str, Row], name: str, token: str, where: str) -> Row:
    """The record that a token stands for.

    Raises:
        ClipError: there is none.
    """
    if token not in table:
        raise ClipError(f"{where}: {name}.json has no record {token!r}")
    return table[token]


def _existing(folder: Path, name: str) -> Path:
    path = folder / f"{name}.json"
    if not path.is_file():
        raise ClipError(f"table {path.name} is missing in {folder.name}")
    return path
