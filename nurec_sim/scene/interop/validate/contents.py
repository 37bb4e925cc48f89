"""Members of any ZIP and the values in its text files; every fault is an ArchiveError.

More lenient than ``zip_package.Package``, like other programs: compressed and unaligned members, unknown names.
"""

from __future__ import annotations

import reprlib
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.closing import Closing
from nurec_sim.files.decoding import LIMITS, TooMuchError, check_directory, json_value, unpacked_limit
from nurec_sim.files.zip_package import MAX_MEMBERS, archive_errors

MAX_MEMBER_BYTES = 2 * 2**30

_short = reprlib.Repr()
_short.maxlevel, _short.maxdict, _short.maxlist, _short.maxstring, _short.maxother = 2, 4, 4, 60, 60


def shown(value: Any) -> str:
    """A short representation of a value for error texts."""
    if isinstance(value, int) and abs(value) > 10**30:
        return "an integer of more than 30 digits"
    return _short.repr(value)


class Contents(Closing):
    """An open ZIP; members are read completely, up to a limit.

    Raises:
        ArchiveError: the file cannot be opened, is no ZIP, or has too many members.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with archive_errors(path.name):
            with path.open("rb") as file:
                check_directory(file)
            self._zip = zipfile.ZipFile(path)
        self.entries = self._zip.infolist()
        self.names = {entry.filename: entry for entry in self.entries}
        if len(self.entries) > MAX_MEMBERS:
            self.close()
            raise ArchiveError(f"{path.name} has {len(self.entries):,} members; at most {MAX_MEMBERS:,} are looked at")

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def folder(self, name: str) -> list[str]:
        """Files below a folder ``name/``."""
        return [each for each in self.names if each.startswith(name + "/") and not each.endswith("/")]

    def read(self, name: str, limit_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """A member's bytes, decompressed.

        Raises:
            ArchiveError: it is missing, damaged, or larger than ``limit_bytes``, whatever its header promises.
        """
        if name not in self.names:
            raise ArchiveError(f"{name} is missing")
        limit_bytes = min(limit_bytes, unpacked_limit(self.names[name].compress_size))
        try:
            with self._zip.open(self.names[name]) as member:
                data = member.read(limit_bytes + 1)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError) as error:
            raise ArchiveError(f"{name} is damaged or cannot be unpacked ({error})") from error
        except (struct.error, ValueError) as error:
            raise ArchiveError(f"{name} is damaged ({error})") from error
        if len(data) > limit_bytes:
            raise ArchiveError(f"{name} has more than {limit_bytes:,} bytes")
        return data

    def json(self, name: str) -> Any:
        """The value of a JSON member by Python's lenient reader: NaN and repeated keys are accepted.

        Raises:
            ArchiveError: missing, damaged, or not JSON.
        """
        try:
            return json_value(self.read(name, LIMITS.json_bytes))
        except TooMuchError as error:
            raise ArchiveError(f"{name} {error}") from None
        except (ValueError, RecursionError) as error:
            raise ArchiveError(f"{name} is not JSON ({error})") from error

    def yaml(self, name: str) -> Any:
        """The value of a YAML member.

        Raises:
            ArchiveError: missing, damaged, too large, or not YAML.
        """
        import yaml

        text = self.read(name, LIMITS.yaml_bytes)
        try:
            return yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, OverflowError, TypeError, AttributeError, RecursionError) as error:
            raise ArchiveError(f"{name} is not YAML ({error})") from error

    def data_offset(self, entry: zipfile.ZipInfo) -> int:
        """Where a member's data start in the file.

        Raises:
            ArchiveError: its local header is not there.
        """
        try:
            with self.path.open("rb") as file:
                file.seek(entry.header_offset)
                header = file.read(30)
        except (OSError, ValueError) as error:
            raise ArchiveError(f"{shown(entry.filename)} lies outside of the file") from error
        if len(header) < 30 or header[:4] != b"PK\x03\x04":
            raise ArchiveError(f"{shown(entry.filename)} has no local header")
        name_length, extra_length = struct.unpack_from("<HH", header, 26)
        return entry.header_offset + 30 + name_length + extra_length

    def close(self) -> None:
        """Closes the file."""
        self._zip.close()


def entry_of(value: Any, key: str, where: str) -> Any:
    """``value[key]`` of a JSON object.

    Raises:
        ArchiveError: not an object, or the key is missing.
    """
    if not isinstance(value, dict):
        raise ArchiveError(f"{where} is no object but {shown(value)}")
    if key not in value:
        raise ArchiveError(f"{where} has no {key!r}")
    return value[key]


def text_of(value: Any, key: str, where: str) -> str:
    """``value[key]``, a non-empty text.

    Raises:
        ArchiveError: missing, or something else.
    """
    text = entry_of(value, key, where)
    if not isinstance(text, str) or not text:
        raise ArchiveError(f"{where}: {key} is no text but {shown(text)}")
    return text


def numbers_of(value: Any, where: str, *shape: int, integers: bool = False) -> np.ndarray:
    """A float64 or int64 array of finite numbers; -1 in ``shape`` stands for any length.

    Raises:
        ArchiveError: another shape, other values, not finite, or floats where integers are read.
    """
    wanted = "x".join("n" if length < 0 else str(length) for length in shape) or "one"
    kind = "integers" if integers else "numbers"
    try:
        array = np.array(value)
    except (ValueError, TypeError, OverflowError):
        raise ArchiveError(f"{where} is not {wanted} {kind}: its rows differ in length") from None
    if array.size == 0 and shape and shape[0] < 0 and array.ndim == 1:
        array = np.zeros((0, *shape[1:]), np.int64)
    same = array.ndim == len(shape) and all(w in (-1, g) for w, g in zip(shape, array.shape, strict=True))
    if not same or array.dtype.kind not in ("iu" if integers else "iuf"):
        found = (
            f"{array.dtype.name} of shape {array.shape}" if array.ndim and array.dtype.kind in "iuf" else shown(value)
        )
        raise ArchiveError(f"{where} is not {wanted} {kind} but {found}")
    if array.dtype.kind == "u" and integers:
        raise ArchiveError(f"{where} holds {int(array.max())}, beyond 64-bit integers")
    if not np.isfinite(array).all():
        raise ArchiveError(f"{where} holds a number that is not finite")
    return array.astype(np.int64 if integers else np.float64)
