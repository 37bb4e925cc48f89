"""``checkpoint.ckpt``: a file of ``torch.save``, read without torch and without unpickling (``files.torch_pickle``)."""

from __future__ import annotations

import zipfile
from typing import BinaryIO

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import TooMuchError, check_directory
from nurec_sim.files.torch_pickle import StoredTensor, read_tensor_pickle
from nurec_sim.files.torch_zip import TorchZipError, is_little_endian, root_of, stored_entries
from nurec_sim.scene.interop.nurec.state import NurecState, read_entries

_BRAIN_FLOATS = "torch.BFloat16Storage"
_TYPES = {
    "torch.FloatStorage": "<f4",
    "torch.HalfStorage": "<f2",
    "torch.DoubleStorage": "<f8",
    "torch.LongStorage": "<i8",
    "torch.IntStorage": "<i4",
    "torch.ShortStorage": "<i2",
    "torch.CharStorage": "<i1",
    "torch.ByteStorage": "<u1",
    "torch.BoolStorage": "?",
    _BRAIN_FLOATS: "<u2",
}


def read_checkpoint(file: BinaryIO, where: str) -> NurecState:
    """Reads the state of a reconstruction; loads only the required arrays.

    Raises:
        ArchiveError: not such a file, truncated, damaged, or unsafe.
    """
    try:
        size = file.seek(0, 2)
        check_directory(file)
        with zipfile.ZipFile(file) as package:
            entries = stored_entries(package, size)
            root = root_of(entries)
            if not is_little_endian(package, entries, root):
                raise ArchiveError(f"{where}: written on a big-endian machine; only little-endian files are read")
            contents = read_tensor_pickle(package.read(f"{root}/data.pkl"))
            return _state(package, entries, root, contents, where, size)
    except (TorchZipError, TooMuchError) as error:
        raise ArchiveError(f"{where} {error}") from error
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise ArchiveError(f"{where}: no file of torch.save, damaged, or cut short ({error})") from error
    except ValueError as error:
        raise ArchiveError(f"{where}: damaged: its list of tensors is {error}") from error


def _state(
    package: zipfile.ZipFile, entries: dict[str, zipfile.ZipInfo], root: str, contents: object, where: str, size: int
) -> NurecState:
    state = contents.get("state_dict") if isinstance(contents, dict) else None
    if not isinstance(state, dict):
        raise ArchiveError(f"{where}: no NuRec checkpoint: 'state_dict' is missing")
    arrays: dict[str, np.ndarray] = {}
    found, others, track_ids = read_entries(state.items())
    for name, (_, value) in found.items():
        if not isinstance(value, StoredTensor):
            raise ArchiveError(f"{where}: {name} must be a tensor")
        arrays[name] = _array(package, entries, root, name, value, where)
        if sum(array.nbytes for array in arrays.values()) > 2 * size:  # bfloat16 values take twice their size
            raise ArchiveError(f"{where}: its tensors show the same values again and again")
    version = contents.get("pytorch-lightning_version") if isinstance(contents, dict) else None
    return NurecState(arrays, track_ids, {}, others, f"Lightning {version}" if isinstance(version, str) else "")


def _array(
    package: zipfile.ZipFile,
    entries: dict[str, zipfile.ZipInfo],
    root: str,
    name: str,
    tensor: StoredTensor,
    where: str,
) -> np.ndarray:
    values = tensor.values
    if values.kind not in _TYPES:
        raise ArchiveError(f"{where}: {name} is of {values.kind!r:.60}; allowed are {sorted(_TYPES)}")
    dtype = np.dtype(_TYPES[values.kind])
    entry = entries.get(f"{root}/data/{values.entry}")
    if entry is None or entry.file_size != values.count * dtype.itemsize:
        held = "none" if entry is None else f"{entry.file_size:,}"
        raise ArchiveError(f"{where}: {name} needs {values.count * dtype.itemsize:,} bytes, the file has {held}")
    stored = np.frombuffer(package.read(entry), dtype)
    if values.kind == _BRAIN_FLOATS:
        # A bfloat16 is the upper half of a float32.
        stored = (stored.astype(np.uint32) << 16).view(np.float32)
    if 0 in tensor.shape:
        return np.zeros(tensor.shape, stored.dtype)
    strides = [step * stored.itemsize for step in tensor.stride]
    # Offsets and strides were validated against the storage by ``torch_pickle``.
    return np.lib.stride_tricks.as_strided(stored[tensor.offset :], tensor.shape, strides).copy()
