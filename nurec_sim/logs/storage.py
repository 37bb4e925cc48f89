"""Files of a clip in a folder, or in a zip file without extracting it; every name and size is validated on read.

Paths inside of a clip are relative, with forward slashes. Sizes are those of ``files.decoding.Limits``.
"""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from tokenize import TokenError
from typing import Any, TypeVar

import numpy as np
from jaxtyping import UInt8

from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import (
    LIMITS,
    TooMuchError,
    check_directory,
    check_member,
    image_pixels,
    json_value,
    npz_arrays,
)

T = TypeVar("T")

META_FILE = "meta.json"
# Exceptions of the zip and numpy readers on corrupt data.
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, ValueError, EOFError, OSError, KeyError,
           MemoryError, NotImplementedError, RuntimeError, SyntaxError, TokenError)  # fmt: skip


def checked_name(name: str) -> str:
    """A relative path that stays inside of the clip.

    Raises:
        ClipError: it is empty, absolute, or climbs out with '..'.
    """
    parts = PurePosixPath(name).parts
    if not parts or name.startswith(("/", "\\")) or "\\" in name or ":" in parts[0] or ".." in parts:
        raise ClipError(f"file name {name!r} is not allowed: a clip names its files by relative paths without '..'")
    return name


def schema_of(path: Path) -> str | None:
    """The ``schema`` in the ``meta.json`` of a clip folder or zip file; None if there is none.

    Raises:
        ClipError: the zip file or ``meta.json`` is damaged or unsafe.
    """
    if not path.is_dir() and not zipfile.is_zipfile(path):
        return None
    storage = Storage(path)
    schema = storage.read_json(META_FILE).get("schema") if storage.exists(META_FILE) else None
    return schema if isinstance(schema, str) else None


def is_cut_zip(path: Path) -> bool:
    """Whether a file begins as a zip does, but its directory is missing: cut short, or damaged at its end.

    What is left may hold a whole zip, such as an ``.npz`` file, whose directory is then found instead.
    """
    with path.open("rb") as file:
        if file.read(4) != b"PK\x03\x04":
            return False
        try:
            check_directory(file)
            with zipfile.ZipFile(file) as archive:
                return min((info.header_offset for info in archive.infolist()), default=1) > 0
        except _DAMAGE:
            return True


def parsed_json(data: bytes, where: str, kind: type[T], noun: str) -> T:
    """The value of a JSON file.

    Args:
        data: the file.
        where: its name, for messages.
        kind: what the value must be.
        noun: the same in words.

    Raises:
        ClipError: it is not JSON, holds NaN or infinity, or is of another kind.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not a number that JSON knows")

    try:
        value = json_value(data, parse_constant=refuse)
    except TooMuchError as error:
        raise ClipError(f"{where} {error}") from None
    except (ValueError, RecursionError) as error:
        raise ClipError(f"{where} is not valid JSON: {error}") from error
    if not isinstance(value, kind):
        raise ClipError(f"{where} must hold {noun}, got {type(value).__name__}")
    return value


def decode_image(data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """The bytes of a JPEG or PNG file as RGB.

    Raises:
        ValueError: they are truncated, not an image, or have too many pixels.
    """
    import cv2

    return np.ascontiguousarray(image_pixels(data, cv2.IMREAD_COLOR)[:, :, ::-1])


class Storage:
    """The files of one clip, from a folder or a zip file (whose clip may lie in one folder at its root).

    Raises:
        ClipError: the path does not exist, is neither a folder nor a zip file, or the zip file is unsafe.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._archive: zipfile.ZipFile | None = None
        self._prefix = ""
        if self.path.is_dir():
            return
        if not self.path.exists():
            raise ClipError(f"no clip at {str(self.path)!r}: give a clip folder or a .zip of one")
        if not zipfile.is_zipfile(self.path):
            raise ClipError(f"{str(self.path)!r} is neither a clip folder nor a zip file")
        try:
            with self.path.open("rb") as file:
                check_directory(file)
            self._archive = zipfile.ZipFile(self.path)
        except _DAMAGE as error:
            raise ClipError(f"{self.path.name}: the zip file is damaged or too large: {error}") from error
        self._prefix = self._check_archive(self._archive)

    def _check_archive(self, archive: zipfile.ZipFile) -> str:
        """Check all names and sizes; return the folder of the clip in the archive."""
        infos = archive.infolist()
        for info in infos:
            try:
                checked_name(info.filename)
            except ClipError as error:
                raise ClipError(f"{self.path.name}: {error}") from None
            try:
                check_member(info, LIMITS.file_bytes)
            except TooMuchError as error:
                raise ClipError(f"{self.path.name}: {info.filename} {error}") from None
        metas = [info.filename for info in infos if PurePosixPath(info.filename).name == META_FILE]
        return min(metas, key=lambda name: (name.count("/"), name), default=META_FILE)[: -len(META_FILE)]

    def exists(self, name: str) -> bool:
        """Whether the clip has a file of that name."""
        checked_name(name)
        if self._archive is None:
            return (self.path / name).is_file()
        return self._prefix + name in self._archive.NameToInfo

    def read(self, name: str) -> bytes:
        """The bytes of a file.

        Raises:
            ClipError: it is missing, too large, or the zip is damaged there.
        """
        checked_name(name)
        if not self.exists(name):
            raise ClipError(f"{self.path.name}: file {name} is missing")
        if self._archive is not None:
            try:
                return self._archive.read(self._prefix + name)
            except _DAMAGE as error:
                raise ClipError(f"{self.path.name}: file {name} in the zip is damaged: {error}") from error
        file = self.path / name
        size = file.stat().st_size
        if size > LIMITS.file_bytes:
            raise ClipError(f"{self.path.name}: file {name} has {size} bytes; at most {LIMITS.file_bytes} are allowed")
        return file.read_bytes()

    def read_json(self, name: str) -> dict[str, Any]:
        """A JSON file that holds an object.

        Raises:
            ClipError: it is missing, not JSON, holds NaN or infinity, or is not an object.
        """
        return parsed_json(self.read(name), f"{self.path.name}: {name}", dict, "a JSON object")

    def read_image(self, name: str) -> UInt8[np.ndarray, "h w 3"]:
        """A JPEG or PNG file as RGB.

        Raises:
            ClipError: it is missing, truncated, not an image, or has too many pixels.
        """
        try:
            return decode_image(self.read(name))
        except ValueError as error:
            raise ClipError(f"{self.path.name}: image {name} {error}") from None

    def read_arrays(self, name: str) -> dict[str, np.ndarray]:
        """The arrays of an .npz file; nothing in it is ever unpickled.

        Raises:
            ClipError: it is missing, truncated, holds objects, or is too large.
        """
        try:
            return npz_arrays(self.read(name))
        except TooMuchError as error:
            raise ClipError(f"{self.path.name}: {name} {error}") from None
        except _DAMAGE as error:
            raise ClipError(f"{self.path.name}: {name} is not a readable .npz file: {error}") from error
