"""The zip archive that ``torch.save`` writes, taken at its word about nothing.

Entries must be stored as they are, lie apart, and be no longer together than the file.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping

MAX_PICKLE_BYTES = 32 << 20


class TorchZipError(Exception):
    """No such archive. The text goes on from the file's name: "is a zip file, but ..."."""


def stored_entries(package: zipfile.ZipFile, size_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Entries by name; compressed ones are refused, for they could grow without bound, and so are overlapping ones.

    Raises:
        TorchZipError: such entries.
    """
    infos = package.infolist()
    for info in infos:
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1 or info.file_size != info.compress_size:
            raise TorchZipError("has compressed or encrypted entries; torch.save writes none")
    entries = {info.filename: info for info in infos}
    if len(entries) != len(infos) or sum(info.file_size for info in infos) > size_bytes:
        raise TorchZipError("is no file of torch.save: its entries overlap")
    return entries


def root_of(entries: Mapping[str, zipfile.ZipInfo]) -> str:
    """The folder in the archive that holds everything.

    Raises:
        TorchZipError: there is none, or several, or its list of tensors is too long.
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
