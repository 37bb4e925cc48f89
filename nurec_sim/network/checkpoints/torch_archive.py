"""Files of ``torch.save``: plain state dicts, and training files that hold a state dict among other things.

Only what the network needs is read: a training file's other objects are never unpickled (``files.torch_pickle``). The
zip archive is taken at its word about nothing: entries must be stored as they are, lie inside the file, and be as long
as the tensors say.
"""

from __future__ import annotations

import math
import mmap
import pickle
import struct
import zipfile
from pathlib import Path

import torch
from torch import Tensor

from nurec_sim.errors import WeightsError
from nurec_sim.files.torch_pickle import StoredTensor, read_tensor_pickle
from nurec_sim.files.torch_zip import TorchZipError, is_little_endian, root_of, stored_entries

_LOCAL_HEADER = struct.Struct("<26xHH")  # the lengths of name and extra field, after which an entry's bytes begin
_TYPES = {
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "DoubleStorage": torch.float64,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}


def read_torch_archive(path: Path) -> dict[str, Tensor]:
    """The state dict in a file of ``torch.save``, on the CPU, in the types of the file.

    A plain dict of tensors comes from ``torch.load(weights_only=True)``. Otherwise ``state_dict`` inside is taken, and
    of it the entries that start with ``model.`` if there are any, without that prefix: what Lightning writes.
    Tensors are views of the mapped file until something copies them.

    Raises:
        WeightsError: the file is no such archive, is damaged, or asks for what it must not.
    """
    try:
        with zipfile.ZipFile(path) as package:
            entries = stored_entries(package, path.stat().st_size)
            if any(name.endswith("/constants.pkl") for name in entries):
                raise WeightsError(
                    f"{path} is a TorchScript program, not weights; give the state dict (.pth, .safetensors)"
                )
            root = root_of(entries)
            contents = read_tensor_pickle(package.read(f"{root}/data.pkl"))
            if not is_little_endian(package, entries, root):
                raise WeightsError(f"{path} was written on a big-endian machine; save it again on another")
    except TorchZipError as error:
        raise WeightsError(f"{path} {error}") from None
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise WeightsError(f"{path} is damaged or cut off: {error}") from None
    except ValueError as error:
        raise WeightsError(f"{path} is damaged: its list of tensors is {error}") from None
    tensors, is_plain = _network_part(path, contents)
    places = {name: _place(path, name, tensor, root, entries) for name, tensor in tensors.items()}
    if is_plain:
        try:
            loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        except pickle.UnpicklingError:  # its text tells people to allow everything
            raise WeightsError(f"{path} holds more than tensors; torch.load(weights_only=True) refuses it") from None
        except (RuntimeError, ValueError) as error:
            raise WeightsError(f"{path} is damaged: {error}") from None
        return {name: tensor.detach() for name, tensor in loaded.items()}
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    return {name: _tensor(path, mapped, tensor, places[name]) for name, tensor in tensors.items()}


def _network_part(path: Path, contents: object) -> tuple[dict[str, StoredTensor], bool]:
    """The named tensors of the network, and whether there is nothing else in the file."""
    part, is_plain = contents, True
    if isinstance(contents, dict) and "state_dict" in contents:
        part, is_plain = contents["state_dict"], False
    if not isinstance(part, dict) or not part:
        raise WeightsError(f"{path} holds no state dict: neither named tensors nor 'state_dict' with such")
    if not is_plain:
        # Training files may keep networks of their losses beside the model.
        model = {
            name.removeprefix("model."): value
            for name, value in part.items()
            if isinstance(name, str) and name.startswith("model.")
        }
        part = model or part
    if others := [k for k, value in part.items() if not (isinstance(k, str) and isinstance(value, StoredTensor))]:
        shown = ", ".join(ascii(name)[:80] if isinstance(name, str) else "a key that is no text" for name in others[:5])
        raise WeightsError(f"{path}: {len(others)} entries of its state dict are no named tensors: {shown}")
    return part, is_plain


def _place(
    path: Path, name: str, tensor: StoredTensor, root: str, entries: dict[str, zipfile.ZipInfo]
) -> tuple[torch.dtype, zipfile.ZipInfo]:
    """Type and entry of a tensor's values, checked against what the archive holds."""
    values = tensor.values
    dtype = _TYPES.get(values.kind.removeprefix("torch."))
    if dtype is None:
        raise WeightsError(f"{path}: {ascii(name)} is of {ascii(values.kind)[:80]}; allowed are {sorted(_TYPES)}")
    entry = entries.get(f"{root}/data/{values.entry}")
    if entry is None or entry.file_size != values.count * dtype.itemsize:
        held = "none" if entry is None else f"{entry.file_size:,} bytes"
        raise WeightsError(
            f"{path} is damaged: {ascii(name)} needs {values.count * dtype.itemsize:,} bytes, has {held}"
        )
    return dtype, entry


def _tensor(path: Path, mapped: mmap.mmap, tensor: StoredTensor, place: tuple[torch.dtype, zipfile.ZipInfo]) -> Tensor:
    """A tensor over the mapped file; writing to it changes memory only."""
    dtype, entry = place
    if not math.prod(tensor.shape):
        return torch.empty(tensor.shape, dtype=dtype)
    start = entry.header_offset + _LOCAL_HEADER.size
    if 0 <= entry.header_offset <= len(mapped) - _LOCAL_HEADER.size:
        start += sum(_LOCAL_HEADER.unpack_from(mapped, entry.header_offset))
    if entry.header_offset < 0 or start + entry.file_size > len(mapped):
        raise WeightsError(f"{path} is damaged: {ascii(entry.filename)} lies outside of the file")
    values = torch.frombuffer(mapped, dtype=dtype, count=tensor.values.count, offset=start)
    return values.as_strided(tensor.shape, tensor.stride, tensor.offset)
