"""The elements of a PLY file as columns of numbers: ascii or binary of either byte order, validated on read.

Format: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32

from nurec_sim.errors import ArchiveError

MAX_HEADER_BYTES = 2**18
MAX_PROPERTIES = 1000
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""NumPy types of PLY types."""
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class VertexTable:
    """An element of a PLY file; binary ones are memory-mapped, so that only requested columns take memory.

    Attributes:
        path: the file.
        names: properties, in the file's order.
        elements: names of all elements of the file.
        comments: the header's, without the word ``comment``.

    Raises:
        ArchiveError: not a PLY file, an invalid or unsupported header, no such element, or fewer rows than declared.
    """

    def __init__(self, path: Path, element: str = "vertex") -> None:
        self.path = path
        try:
            with path.open("rb") as file:
                form, elements, self.comments = _read_header(file, path)
                before, count, types = _find(elements, element, path)
                self.names, self.elements = tuple(types), tuple(each.name for each in elements)
                start, size = file.tell(), os.fstat(file.fileno()).st_size
                if form == "ascii":
                    if before:
                        raise ArchiveError(f"{path}: of an ascii file only the first element is read, not {element!r}")
                    self._rows: np.ndarray = _read_text(file, path, count, len(types), size - start)
                    return
        except OSError as error:
            raise ArchiveError(f"{path}: cannot be opened ({error.strerror or error})") from error
        order = BYTE_ORDERS[form]
        start += sum(each.count * _row_type(each.types, order).itemsize for each in before)
        dtype = _row_type(types, order)
        _check_size(path, count, dtype.itemsize, size - start, "")
        self._rows = np.memmap(path, dtype, "r", start, (count,)) if count else np.zeros(0, dtype)

    def __len__(self) -> int:
        return len(self._rows)

    def column(self, name: str) -> np.ndarray:
        """A property of a binary file without conversion, ``[n]``."""
        return self._rows[name]

    def columns(self, names: Sequence[str]) -> Float32[np.ndarray, "n names"]:
        """Several properties as columns; numbers too large for a float become infinite.

        Raises:
            ArchiveError: properties are missing; the text lists them.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise ArchiveError(f"{self.path}: the vertices lack {missing}; they have {list(self.names)}")
        result = np.empty((len(self), len(names)), np.float32)
        with np.errstate(over="ignore"):
            for k, name in enumerate(names):
                result[:, k] = self._rows[name] if self._rows.dtype.names else self._rows[:, self.names.index(name)]
        return result


def _check_size(path: Path, count: int, least_bytes: int, held_bytes: int, at_least: str) -> None:
    """Checks the declared size against the file size before allocating memory."""
    if count * least_bytes > held_bytes:
        raise ArchiveError(
            f"{path}: the header promises {count:,} vertices of {at_least}{least_bytes} bytes, but "
            f"{held_bytes:,} bytes follow it; is the file cut short?"
        )


def _read_text(file: BinaryIO, path: Path, count: int, width: int, held_bytes: int) -> np.ndarray:
    """Rows of numbers [count, width]; each number takes at least a digit and a separator."""
    _check_size(path, count, max(2 * width - 1, 1), held_bytes, "at least ")
    if not count:
        return np.zeros((0, width))
    try:
        with warnings.catch_warnings():  # of no rows: that is found below
            warnings.simplefilter("ignore", UserWarning)
            rows = np.loadtxt(file, np.float64, comments=None, max_rows=count, ndmin=2, encoding="latin1")
    except ValueError as error:
        raise ArchiveError(f"{path}: a vertex is not readable: {error}") from error
    if rows.shape != (count, width):
        raise ArchiveError(f"{path}: {count:,} vertices of {width} numbers are promised, {rows.shape} found")
    return rows


# --------------------------------------------------------------------------------------------------------- header


@dataclass
class _Element:
    """``types`` are NumPy's, by the names of the properties; ``lists`` says whether there are others."""

    name: str
    count: int
    types: dict[str, str] = field(default_factory=dict)
    lists: bool = False


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[_Element], list[str]]:
    """Format, elements and comments; the file is left at the first row of the first one."""
    if file.readline(8).strip() != b"ply":
        raise ArchiveError(f"{path}: not a PLY file; its first line must be 'ply'")
    form: str | None = None
    elements: list[_Element] = []
    comments: list[str] = []
    for line in _header_lines(file, path):
        match line.split():
            case ["comment", *words]:
                comments.append(" ".join(words))
            case [] | ["obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in BYTE_ORDERS and form is None:
                form = name
            case ["element", name, count] if count.isdecimal() and len(count) <= 18:
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, _] if elements and elements[-1].name != "vertex":
                elements[-1].lists = True
            case ["property", kind, name] if elements and kind in TYPES and name not in elements[-1].types:
                elements[-1].types[name] = TYPES[kind]
                if len(elements[-1].types) > MAX_PROPERTIES:
                    raise ArchiveError(f"{path}: more than {MAX_PROPERTIES} properties of {elements[-1].name!r}")
            case _:
                raise ArchiveError(f"{path}: the header line {line[:80]!r} is wrong or not supported")
    if form is None:
        raise ArchiveError(f"{path}: the header names no format; allowed are {list(BYTE_ORDERS)}")
    return form, elements, comments


def _find(elements: list[_Element], name: str, path: Path) -> tuple[list[_Element], int, dict[str, str]]:
    """The elements before the one of a name, its count and its types."""
    names = [element.name for element in elements]
    if name not in names:
        raise ArchiveError(f"{path}: no element {name!r}; it has {names}")
    before, found = elements[: names.index(name)], elements[names.index(name)]
    if any(element.lists for element in before):
        raise ArchiveError(f"{path}: lists come before the element {name!r}; that is not supported; it has {names}")
    if not found.types or found.lists:
        raise ArchiveError(f"{path}: the element {name!r} has {'lists' if found.lists else 'no properties'}")
    return before, found.count, found.types


def _row_type(types: dict[str, str], order: str) -> np.dtype:
    return np.dtype([(name, order + kind) for name, kind in types.items()])


def _header_lines(file: BinaryIO, path: Path) -> Iterator[str]:
    """Lines up to ``end_header``, as text."""
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        if line.strip() == b"end_header":
            return
        if not line.endswith(b"\n"):
            break
        yield line.decode("latin1").strip()
    raise ArchiveError(f"{path}: no 'end_header' line in the first {MAX_HEADER_BYTES:,} bytes")
