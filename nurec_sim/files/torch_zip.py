"""The zip archive that ``torch.save`` writes, validated before use.

Entries must be stored uncompressed, must not overlap, and their total size must not exceed the file's.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping

MAX_PICKLE_BYTES = 32 << 20


class TorchZipError(Exception):
    """Not such an archive. The text continues a sentence that begins with the file's name: "is a zip file, but ..."."""


def stored_entries(package: zipfile.ZipFile, size_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Entries by name; compressed entries are refused because they could expand without bound, overlapping ones too.

    Raises:
        TorchZipError: such entries.
    """
    infos = package.infolist()
    for info in infos:
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1 or info.file_size != info.compress_size:
            raise TorchZipError("has compressed or encrypted entries; torch.save writes none")
    entries = {info.filename: info for info in infos}
    # Stored entries that do not overlap cannot add up to more than the file.
    if len(entries) != len(infos) or sum(info.file_size for info in infos) > size_bytes:
        raise TorchZipError("is no file of torch.save: its entries overlap")
    return entries


def root_of(entries: Mapping[str, zipfile.ZipInfo]) -> str:
    """The folder in the archive that holds everything.

    Raises:
        TorchZipError: there is no such folder, or several, or ``data.pkl`` is too large.
    """
    roots = [name.removesuffix("/data.pkl") for name in entries if name.endswith("/data.pkl") and name.count("/") == 1]
    if len(roots) != 1:
        raise TorchZipError("is a zip file, but not one that torch.save writes: no data.pkl in it")
    if entries[f"{roots[0]}/data.pkl"].file_size > MAX_PICKLE_BYTES:
        raise TorchZipError(f"has a list of tensors of more than {MAX_PICKLE_BYTES >> 20} MiB")
    return roots[0]


def is_little_endian(package: zipfile.ZipFile, entries: Mapping[str, zipfile.ZipInfo], root: str) -> bool:
    """Whether values are stored little-endian, as almost all machines write them."""
    return f"{root}/byteorder" not in entries or package.read(f"{root}/byteorder") == b"little"
