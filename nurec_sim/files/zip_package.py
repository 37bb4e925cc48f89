"""A USDZ package: a ZIP of stored, 64-byte aligned members, written reproducibly and validated on read.

Format: https://openusd.org/release/spec_usdz.html. OpenUSD has no ZIP64, so a member and the whole file stay below
4 GiB. Every member carries the same time stamp (1980-01-01) and the padding extra field of OpenUSD (id 0x1986), so
equal content gives equal bytes.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import mmap
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from nurec_sim.errors import ArchiveError
from nurec_sim.files.closing import Closing
from nurec_sim.files.decoding import TooMuchError, check_directory
from nurec_sim.files.new_files import new_file

ALIGNMENT = 64
MAX_PACKAGE_BYTES = 2**32 - 1
MAX_MEMBERS = 20_000
_PADDING_ID = 0x1986
_DOS_DATE = (1980 - 1980) << 9 | 1 << 5 | 1
_LOCAL = struct.Struct("<IHHHHHIIIHH")
_CENTRAL = struct.Struct("<IHHHHHHIIIHHHHHII")
_END = struct.Struct("<IHHHHIIH")


def write_package(path: Path, members: Mapping[str, bytes]) -> None:
    """Writes a package atomically, members in the given order; the first one must be the root layer.

    Raises:
        ArchiveError: the package would exceed 4 GiB, or a name is not allowed.
    """
    # A bound: both headers with the name in each take 76 bytes, the padding less than 68.
    total = sum(len(data) + 2 * len(name) + 256 for name, data in members.items())
    if total > MAX_PACKAGE_BYTES:
        raise ArchiveError(f"the archive would take {total:,} bytes; USDZ packages end at {MAX_PACKAGE_BYTES:,}")
    with new_file(path) as file:
        central = b"".join(_write_member(file, name, data) for name, data in members.items())
        start = file.tell()
        file.write(central)
        file.write(_END.pack(0x06054B50, 0, 0, len(members), len(members), len(central), start, 0))


def _write_member(file, name: str, data: bytes) -> bytes:
    """Writes one member and returns its entry of the central directory."""
    fault = name_fault(name)
    if fault:
        raise ArchiveError(f"cannot store {name!r}: {fault}")
    raw_name, crc, offset = name.encode("utf-8"), zlib.crc32(data), file.tell()
    # Local header (APPNOTE 4.3.7): version 2.0, method 0 (stored), sizes known in advance.
    before_extra = offset + _LOCAL.size + len(raw_name)
    # The padding goes into the extra field, whose own header takes 4 bytes, so that the data start aligned.
    padding = -(before_extra + 4) % ALIGNMENT
    extra = struct.pack("<HH", _PADDING_ID, padding) + bytes(padding)
    # Bit 11 of the flags: the name is UTF-8 (APPNOTE 4.4.4).
    utf8_names = 0 if name.isascii() else 0x800
    common = (20, utf8_names, 0, 0, _DOS_DATE, crc, len(data), len(data), len(raw_name))
    file.write(_LOCAL.pack(0x04034B50, *common, len(extra)) + raw_name + extra)
    file.write(data)
    return _CENTRAL.pack(0x02014B50, 20, *common, 0, 0, 0, 0, 0, offset) + raw_name


def name_fault(name: str) -> str | None:
    """Why a member name is not allowed, or None: only relative paths that stay inside the package."""
    if not name or "\0" in name or "\\" in name:
        return "empty names, NUL and backslashes are not allowed"
    if name.startswith("/") or ":" in name.split("/")[0]:
        return "absolute paths are not allowed"
    if any(part in ("", ".", "..") for part in name.rstrip("/").split("/")) or PurePosixPath(name).is_absolute():
        return "paths must stay inside the archive"
    return None


@contextlib.contextmanager
def archive_errors(name: object) -> Iterator[None]:
    """What opening a ZIP file raises becomes an ``ArchiveError`` with the file's name."""
    try:
        yield
    except TooMuchError as error:
        raise ArchiveError(f"{name} {error}") from None
    except OSError as error:
        raise ArchiveError(f"{name}: cannot be opened ({error.strerror or error})") from error
    except (zipfile.BadZipFile, NotImplementedError, struct.error, ValueError) as error:
        raise ArchiveError(f"{name}: not a readable ZIP archive, or cut short ({error})") from error


class Package(Closing):
    """An open package; members are views of the memory-mapped file, nothing is extracted or decompressed.

    Raises:
        ArchiveError: not a ZIP file, truncated, or with a compressed, encrypted, duplicate, overlapping or badly named
            member. This rules out decompression bombs.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._spans: dict[str, tuple[int, int]] = {}
        with archive_errors(path):
            with path.open("rb") as file:
                self._size = os.fstat(file.fileno()).st_size
                if not 22 <= self._size <= MAX_PACKAGE_BYTES:
                    raise ArchiveError(
                        f"{path}: {self._size:,} bytes; a scene archive has 22 to {MAX_PACKAGE_BYTES:,} bytes"
                    )
                check_directory(file)
                with zipfile.ZipFile(file) as archive:
                    entries = archive.infolist()
                self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        try:
            self._index(entries)
        except ArchiveError:
            self.close()
            raise

    def _index(self, entries: list[zipfile.ZipInfo]) -> None:
        if len(entries) > MAX_MEMBERS:
            raise ArchiveError(f"{self.path}: {len(entries):,} members; at most {MAX_MEMBERS:,} are allowed")
        for entry in entries:
            where = f"{self.path}: member {entry.filename!r}"
            # ``zipfile`` cuts names at NUL bytes and converts separators; the name as stored counts too.
            fault = name_fault(entry.orig_filename) or name_fault(entry.filename)
            if fault:
                raise ArchiveError(f"{where}: {fault}")
            if entry.filename in self._spans:
                raise ArchiveError(f"{where} appears twice")
            if entry.flag_bits & 0x1:
                raise ArchiveError(f"{where} is encrypted")
            # The upper 16 bits are the Unix mode, whose highest 4 are the file type; 0xA is S_IFLNK.
            if (entry.external_attr >> 28) == 0xA:
                raise ArchiveError(f"{where} is a symbolic link")
            if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
                raise ArchiveError(
                    f"{where} is compressed ({entry.compress_size:,} -> {entry.file_size:,} bytes); "
                    "a USDZ archive holds stored members only"
                )
            self._spans[entry.filename] = self._locate(entry, where)
        ordered = sorted((start, stop, name) for name, (start, stop) in self._spans.items())
        # Overlapping members would let a small file pretend to hold more data than it has.
        for (_, stop, name), (start, _, after) in zip(ordered, ordered[1:], strict=False):
            if start < stop:
                raise ArchiveError(f"{self.path}: members {name!r} and {after!r} overlap")

    def _locate(self, entry: zipfile.ZipInfo, where: str) -> tuple[int, int]:
        """[start, stop) of a member's data, from its local header."""
        if entry.header_offset < 0 or entry.header_offset + _LOCAL.size > self._size:
            raise ArchiveError(f"{where} lies outside the file; is the archive cut short?")
        header = _LOCAL.unpack_from(self._bytes, entry.header_offset)
        if header[0] != 0x04034B50:
            raise ArchiveError(f"{where} has no local header; the archive is damaged")
        # Lengths of name and extra field from the local header: they may differ from the central directory's.
        start = entry.header_offset + _LOCAL.size + header[9] + header[10]
        if start + entry.file_size > self._size:
            raise ArchiveError(f"{where} lies outside the file; is the archive cut short?")
        return start, start + entry.file_size

    @property
    def names(self) -> list[str]:
        """Member names, in the order of the central directory."""
        return list(self._spans)

    def size(self, name: str) -> int:
        """Size of a member in bytes."""
        start, stop = self._span(name)
        return stop - start

    def read(self, name: str, limit_bytes: int = MAX_PACKAGE_BYTES) -> bytes:
        """A member's bytes.

        Raises:
            ArchiveError: no such member, or it is larger than ``limit_bytes``.
        """
        start, stop = self._span(name)
        if stop - start > limit_bytes:
            raise ArchiveError(f"{self.path}: {name} has {stop - start:,} bytes; at most {limit_bytes:,} are read")
        return self._bytes[start:stop]

    def open(self, name: str) -> io.BufferedReader:
        """A member as a file object, valid until the package is closed.

        Raises:
            ArchiveError: no such member.
        """
        return io.BufferedReader(_Member(self._bytes, *self._span(name)))

    def sha256(self, name: str) -> str:
        """Hash of a member, hexadecimal."""
        start, stop = self._span(name)
        digest = hashlib.sha256()
        with memoryview(self._bytes) as view, view[start:stop] as member:
            digest.update(member)
        return digest.hexdigest()

    def _span(self, name: str) -> tuple[int, int]:
        if name not in self._spans:
            raise ArchiveError(f"{self.path}: {name} is missing; have {sorted(self._spans)[:20]}")
        return self._spans[name]

    def close(self) -> None:
        """Unmaps the file."""
        self._bytes.close()


class _Member(io.RawIOBase):
    """A range of a mapped file as a raw file object."""

    def __init__(self, source: mmap.mmap, start: int, stop: int) -> None:
        self._source, self._start, self._stop, self._at = source, start, stop, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._stop - self._start}[whence]
        if base + offset < 0:
            raise OSError(f"cannot seek to {base + offset}")
        self._at = base + offset
        return self._at

    def readinto(self, buffer) -> int:
        first = min(self._start + self._at, self._stop)
        chunk = self._source[first : min(first + len(buffer), self._stop)]
        buffer[: len(chunk)] = chunk
        self._at += len(chunk)
        return len(chunk)
